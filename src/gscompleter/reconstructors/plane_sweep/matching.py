"""Matching of the planes of a sweep: costs, semi-global aggregation, and the cheapest plane.

Two implementations of one search: the kernels of the CPU, and tensors for a GPU (decision 142).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int16, Int32, Int64, UInt8
from torch import Tensor

from gscompleter.numerics.kernels import stereo
from gscompleter.numerics.kernels.stereo import TILE_COLUMNS, TILE_ROWS, Bands
from gscompleter.numerics.tensor_stereo import (
    CostRule,
    JumpPenalties,
    MatchedSource,
    TilePlanes,
    aggregate_volumes,
    compute_cost_volume,
    estimate_search_bytes,
    prefer_given_planes,
    select_volume_planes,
)
from gscompleter.reconstructors.features.neighbours import NUM_SOURCES
from gscompleter.reconstructors.features.stereo_image import StereoImage, compute_contrast
from gscompleter.reconstructors.plane_sweep.rig import Transform

PixelMap = Float32[np.ndarray, "h w"]
JumpMap = Int16[np.ndarray, "_ _"]
Planes = Float32[np.ndarray, "d"]
"""Inverse depths from far to near, evenly spaced."""
Source = tuple[StereoImage, Transform]
"""Another view, and the transform from reference pixels to its pixels."""

CORRELATION_RADIUS = 2
"""Radius of the correlation window, in pixels."""
IMAGE_NOISE = np.float32(0.015)
"""Standard deviation of the image noise; weaker texture does not correlate."""
PIXEL_WEIGHT = np.float32(0.4)
"""Weight of the per-pixel difference in the cost; the rest is window correlation."""
GIVEN_SHARE = np.float32(1 / 8)
"""Weight of the matching cost at pixels with given depth."""
GIVEN_COST = np.float32(60)
"""Cost of each plane between a pixel's given depth and the plane it is matched at."""
UNSEEN_COST = np.uint8(140)
"""Cost, from 0 to 254, of a plane at which no other view observes the pixel."""

MAX_COST = np.uint8(254)
"""Largest cost of a plane that a source sees."""
COVERING_PENALTY = np.uint8(16)
"""Additional cost in a source that was chosen for what it covers. It often stands so near that all
planes look alike in it: without, depth gets coarser, and if it counts only where no other source
sees the plane, near things at the side of a photograph are lost."""

SMALL_PENALTY = 25
"""Cost of a change by one plane between neighbouring pixels."""
LARGE_PENALTY = 300
"""Cost of a larger jump between neighbouring pixels of the same colour."""
GROUP_CELLS = 2**27
"""Most costs of views that a device searches at once, so that these take less than a large view."""
JUMP_CONTRAST = np.float32(0.06)
"""Colour difference at which the penalty of a jump is halved."""
COST_RULE = CostRule(
    radius=CORRELATION_RADIUS,
    floor=float(np.float32(3 * (2 * CORRELATION_RADIUS + 1) ** 2) * IMAGE_NOISE * IMAGE_NOISE),
    detail=float(PIXEL_WEIGHT),
    num_best=NUM_SOURCES,
    covering_penalty=int(COVERING_PENALTY),
    unseen_cost=int(UNSEEN_COST),
)
"""The same for tensors."""


@dataclass(frozen=True)
class PlaneSearch:
    """The search for the best plane of each pixel of one view."""

    reference: StereoImage
    sources: Sequence[Source]
    planes: Planes
    bands: Bands
    given: PixelMap
    """Plane of a given depth, to a fraction; -1 where none is given."""


def search_with_kernels(search: PlaneSearch) -> tuple[PixelMap, PixelMap]:
    """Find the best plane of each pixel, to a fraction, and the cost gap to the second best one."""
    costs = compute_costs(search.reference, search.sources, search.planes, search.bands)
    stereo.prefer_given(costs, search.bands, search.given, GIVEN_SHARE, GIVEN_COST)
    totals = aggregate(costs, search.bands, search.reference)
    return stereo.select_planes(totals, search.bands, *search.reference.size)


def search_with_tensors(
    searches: Sequence[PlaneSearch], device: str
) -> list[tuple[PixelMap, PixelMap]]:
    """Find the same for several views on a device; the host waits once for each group of them.

    Costs differ by one in 254 where a rounding falls on the other side; all that follows is exact.
    """
    found: dict[int, tuple[PixelMap, PixelMap]] = {}
    for numbers in group_searches(searches):
        group = [searches[number] for number in numbers]
        found.update(zip(numbers, search_group(group, device), strict=True))
    return [found[number] for number in range(len(searches))]


def group_searches(searches: Sequence[PlaneSearch]) -> list[list[int]]:
    """Group the numbers of searches in images of one size, as far as their costs take little."""
    of_size: dict[tuple[int, int], list[int]] = {}
    for number, search in enumerate(searches):
        of_size.setdefault(search.reference.size, []).append(number)
    groups = []
    for size, numbers in of_size.items():
        most = count_grouped(size, max(len(searches[number].planes) for number in numbers))
        groups += [numbers[begin : begin + most] for begin in range(0, len(numbers), most)]
    return groups


def count_grouped(size: tuple[int, int], num_planes: int) -> int:
    """Count the views of a size that are searched together, if there are so many."""
    height, width = size
    return max(1, GROUP_CELLS // (height * width * num_planes))


def estimate_group_bytes(sizes: Sequence[tuple[int, int]], num_planes: int) -> int:
    """Estimate the most bytes that `search_with_tensors` holds at once for views of these sizes.

    Sizes are heights and widths in pixels.
    """
    groups = {size: min(sizes.count(size), count_grouped(size, num_planes)) for size in set(sizes)}
    return max(estimate_search_bytes(size, num_planes, number) for size, number in groups.items())


def search_group(group: Sequence[PlaneSearch], device: str) -> list[tuple[PixelMap, PixelMap]]:
    """Find the best planes of views of one size on a device."""

    def upload(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device, non_blocking=True)

    size = group[0].reference.size
    num_planes = max(len(search.planes) for search in group)
    volumes = []
    for search in group:
        volume = compute_cost_volume(
            upload(search.reference.image),
            [
                MatchedSource(
                    upload(source.image).permute(2, 0, 1).flatten(1), source.size, upload(transform)
                )
                for source, transform in search.sources
            ],
            upload(search.planes),
            TilePlanes(*map(upload, list_tile_planes(search.bands))),
            num_planes,
            COST_RULE,
        )
        if (search.given >= 0).any():
            given = upload(search.given)
            prefer_given_planes(volume, given, float(GIVEN_SHARE), float(GIVEN_COST))
        volumes.append(volume)

    # A single volume, which may be large, is not copied.
    stacked = volumes[0][None] if len(group) == 1 else torch.stack(volumes)
    jumps = [compute_jumps(search.reference) for search in group]
    of_views = [upload(np.stack(maps)) for maps in zip(*jumps, strict=True)]
    totals = aggregate_volumes(stacked, JumpPenalties(*of_views), SMALL_PENALTY)
    selected = []
    for volume, total, search in zip(stacked, totals, group, strict=True):
        low = upload(spread_over_tiles(search.bands.low, size))
        high = upload(spread_over_tiles(search.bands.high, size))
        selected.append(select_volume_planes(total, volume, low, high))
    return [(index, margin) for index, margin in torch.stack(selected).cpu().numpy()]


def list_tile_planes(bands: Bands) -> Int64[np.ndarray, "3 pairs"]:
    """List the row and column of each tile at each of its planes, and the plane."""
    counts = (bands.high - bands.low).reshape(-1)
    tiles = np.repeat(np.arange(counts.size), counts)
    ends = np.cumsum(counts)
    within = np.arange(len(tiles)) - (ends - counts)[tiles]
    rows, columns = np.divmod(tiles, bands.low.shape[1])
    return np.stack([rows, columns, bands.low.reshape(-1)[tiles] + within]).astype(np.int64)


def spread_over_tiles(
    values: Int32[np.ndarray, "r c"], size: tuple[int, int]
) -> Int16[np.ndarray, "h w"]:
    """Give each pixel of an image of `size` the value of its tile."""
    rows = np.arange(size[0])[:, None] // TILE_ROWS
    return values[rows, np.arange(size[1]) // TILE_COLUMNS].astype(np.int16)


def compute_costs(
    reference: StereoImage, sources: Sequence[Source], planes: Planes, bands: Bands
) -> UInt8[np.ndarray, "cells"]:
    """Compute costs (0 to 254) of the planes in `bands`; the best source view counts.

    The best, rather than the mean: a surface that one source sees may be occluded in the others.
    Those from `NUM_SOURCES` on cover what the first ones leave out, and cost more where these see a
    plane.
    """
    costs = [
        stereo.compute_matching_costs(
            reference.image,
            source.image,
            transform,
            planes,
            bands,
            CORRELATION_RADIUS,
            IMAGE_NOISE,
            PIXEL_WEIGHT,
        )
        for source, transform in sources
    ]
    best = np.minimum.reduce(costs[:NUM_SOURCES])
    for covering in costs[NUM_SOURCES:]:
        dearer = np.minimum(covering, MAX_COST - COVERING_PENALTY) + COVERING_PENALTY
        best = np.where(best == stereo.UNSEEN, covering, np.minimum(best, dearer))
    return np.where(best == stereo.UNSEEN, UNSEEN_COST, best)


def aggregate(
    costs: UInt8[np.ndarray, "cells"], bands: Bands, reference: StereoImage
) -> Int16[np.ndarray, "cells"]:
    """Sum the costs along eight paths through the image; jumps are cheap at image edges."""
    jumps = compute_jumps(reference)
    return stereo.aggregate_semi_globally(costs, bands, *jumps, np.int16(SMALL_PENALTY))


def compute_jumps(reference: StereoImage) -> tuple[JumpMap, JumpMap, JumpMap, JumpMap]:
    """Compute the penalties of jumps along rows, columns and both diagonals.

    Each pair of neighbours serves two opposite paths.
    """
    image = reference.image

    def jump(a: Float32[np.ndarray, "r c 3"], b: Float32[np.ndarray, "r c 3"]) -> JumpMap:
        penalty = LARGE_PENALTY / (1 + compute_contrast(a, b) / JUMP_CONTRAST)
        # Even at the strongest edge a jump is dearer than a change by one plane (P2 > P1).
        return np.rint(np.maximum(penalty, 1.5 * SMALL_PENALTY)).astype(np.int16)

    return (
        jump(image[:, 1:], image[:, :-1]),
        jump(image[1:], image[:-1]),
        jump(image[1:, 1:], image[:-1, :-1]),
        jump(image[:-1, 1:], image[1:, :-1]),
    )
