"""Stereo depth of each view by a plane sweep, before surfaces are fitted.

A plane is one inverse depth, parallel to the image of the reference view (Collins 1996). Each pixel
gets a cost at each plane, from the other views; semi-global matching (Hirschmüller 2008) smooths
the costs, and the cheapest plane wins. Large images are swept at half size first, so that each tile
of the full size is matched only near the planes found there.

Lengths are in widest baselines (`Rig.unit`), so that inverse depths are in their inverse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int

from gscompleter.numerics.kernels import stereo
from gscompleter.numerics.kernels.stereo import TILE_COLUMNS, TILE_ROWS, Bands
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.depth_devices import get_depth_device
from gscompleter.reconstructors.plane_sweep.matching import Planes, PlaneSearch, Source
from gscompleter.reconstructors.plane_sweep.rig import Rig, Transform

Map = Float32[np.ndarray, "_ _"]
Mask = Bool[np.ndarray, "_ _"]
Neighbour = tuple[Map, Transform, Transform]
"""Inverse depths of another view, and the transforms to its pixels and back (`Transforms`)."""

MAX_RETURN_ERROR = 1.5
"""Largest error, in pixels, of a match that is reprojected to the other view and back."""
FULL_MARGIN = 40.0
"""Cost gap between the best and the second best plane that gives full confidence."""
MAX_SPECKLE_AREA = 60
"""Largest patch of similar depth that is a speckle, in pixels."""
MAX_PATCH_STEP = 2.0
"""Largest step between neighbouring pixels of one patch, in planes."""
UNKNOWN = np.float32(1e-9)
"""Inverse depth of pixels without a confident depth."""

MIN_GUIDED_SIDE = 192
"""Shortest image side, in pixels, from which a half-size sweep narrows the search."""
BACKGROUND_WEIGHT = np.float32(0.3)
"""Weight of a background depth at pixels occluded in the other views."""

MAX_PLANE_MOTION = 0.5
"""Largest image motion between neighbouring planes, in pixels."""
MIN_PLANES, MAX_PLANES = 48, 256
"""Smallest and largest number of planes."""
MIN_SEEN_GRID = 0.02
"""Share of a grid of pixels that some source has to see at the nearest plane."""
MIN_USED_SAMPLES = 8
"""Fewest of the sampled steps of inverse depth that the planes reach over, so that they have an
extent where no source sees more than the farthest."""

MEDIAN_SIZE = 5
"""Size in pixels of the median filter that removes outliers from a first guess."""
GUESS_MARGIN = 1
"""Margin in pixels of the first guess by which a band includes surrounding depths."""
EXTRA_PLANES = 3
"""Extra planes on both sides of the guessed range."""


@dataclass(frozen=True)
class Sweep:
    """The best plane of each pixel of one view."""

    planes: Planes
    index: Map
    """Number of the best plane, to a fraction."""
    margin: Map
    """Cost gap to the second best plane."""

    @cached_property
    def inverse(self) -> Map:
        """Inverse depths of the best planes."""
        return compute_inverse_depth(self.planes, self.index)


@dataclass(frozen=True)
class Measurement:
    """The plane of each pixel of one view, with weights."""

    planes: Planes
    index: Map
    """As of `Sweep`; pixels that are occluded in the other views have that of the background."""
    weight: Map
    """Weight for the surface fit, in [0, 1]."""
    confidence: Map
    """Like `weight`, but 0 for depths taken from surrounding pixels."""

    @property
    def inverse(self) -> Map:
        """Inverse depths of the planes."""
        return compute_inverse_depth(self.planes, self.index)

    def resize_to(self, size: tuple[int, int]) -> Measurement:
        """Upsample to `size` if the image was halved."""
        if self.index.shape == size:
            return self
        return Measurement(
            self.planes,
            index=repeat_pixels(self.index, size),
            weight=repeat_pixels(self.weight, size),
            confidence=repeat_pixels(self.confidence, size),
        )

    def exclude(self, mask: Bool[np.ndarray, "h w"]) -> Measurement:
        """Set weight and confidence to 0 at the pixels of a full-size mask, such as the sky."""
        full = self.resize_to(mask.shape)
        none = np.float32(0)
        return replace(
            full,
            weight=np.where(mask, none, full.weight),
            confidence=np.where(mask, none, full.confidence),
        )


def measure_depths(rig: Rig, near: float, far: float) -> list[Measurement]:
    """Measure the depth of each view, between two z-depths in scene units."""
    sweeps = sweep_views(rig, near / rig.unit, far / rig.unit)
    inverses = [sweep.inverse for sweep in sweeps]

    # Left-right check: a depth counts if one other view measured the same surface there.
    confidences = []
    for i, sweep in enumerate(sweeps):
        checks = []
        for neighbour in pair_up(i, inverses, rig):
            # The error is -1 where the pixel falls outside the other view.
            error, _ = stereo.reproject(sweep.inverse, *neighbour)
            checks.append((error >= 0) & (error < MAX_RETURN_ERROR))
        confidences.append(compute_confidence(sweep.index, sweep.margin, np.any(checks, axis=0)))

    # Occlusions are judged by confident depths only: a wrong one in front would occlude anything.
    sure = [np.where(c > 0, w, UNKNOWN) for c, w in zip(confidences, inverses, strict=True)]
    return [
        add_background(sweep, confidence, pair_up(i, sure, rig))
        for i, (sweep, confidence) in enumerate(zip(sweeps, confidences, strict=True))
    ]


def pair_up(number: int, inverses: Sequence[Map], rig: Rig) -> list[Neighbour]:
    """List the views that view `number` is compared with, with their inverse depths."""
    return [
        (inverses[i], rig.transforms[number, i], rig.transforms[i, number])
        for i in rig.neighbours.find_partners(number)
    ]


def add_background(sweep: Sweep, confidence: Map, neighbours: Sequence[Neighbour]) -> Measurement:
    """Give pixels that are occluded in the confident depths of others the background depth.

    A pixel that no other view observes cannot be matched, so its best plane is arbitrary. It shows
    the surface behind the occluder, which continues beside the unmatched pixels.
    """
    background = stereo.fill_background(sweep.index, confidence > 0)
    behind = compute_inverse_depth(sweep.planes, background)
    occluded = (confidence == 0) & find_hidden_pixels(behind, neighbours)
    weight = np.where(occluded, BACKGROUND_WEIGHT, confidence)
    index = np.where(occluded, background, sweep.index)
    return Measurement(sweep.planes, index, weight, confidence)


def compute_confidence(index: Map, margin: Map, confirmed: Mask) -> Map:
    """Compute the confidence of each pixel's plane, in [0, 1].

    `margin` is the cost gap to the second best plane; `confirmed` marks pixels that another view
    confirms.
    """
    solid = remove_speckles(index, confirmed)
    return (solid * (margin / FULL_MARGIN).clip(0, 1)).astype(np.float32)


def remove_speckles(index: Map, mask: Mask) -> Mask:
    """Remove patches of similar depth of at most `MAX_SPECKLE_AREA` pixels from `mask`."""
    # OpenCV takes 16-bit fixed-point disparities; 0 marks masked pixels. Without the offset by
    # one plane, a pixel of the farthest plane would count as masked.
    scale = min(16.0, 30000.0 / max(float(index.max()), 1.0))
    levels = np.where(mask, index.clip(0) * scale + scale, 0).astype(np.int16)
    cv2.filterSpeckles(levels, 0, MAX_SPECKLE_AREA, MAX_PATCH_STEP * scale)
    return levels > 0


def find_hidden_pixels(background: Map, neighbours: Sequence[Neighbour]) -> Mask:
    """Mark background surfaces that some view occludes and no view observes."""
    hidden = np.zeros(background.shape, bool)
    seen = np.zeros(background.shape, bool)
    for neighbour in neighbours:
        error, ratio = stereo.reproject(background, *neighbour)
        # `ratio` is z as expected in the other view over z as measured there; near 0 it is unknown.
        known = (error >= 0) & (ratio > 1e-3)
        # The other view measured something nearer, and not merely the same surface inexactly.
        before = known & (error > MAX_RETURN_ERROR) & (ratio > 1)
        # The ray of the pixel, at the depth of the occluder, has to lie in the other view, too.
        within, _ = stereo.reproject(background * ratio, *neighbour)
        hidden |= before & (within >= 0)
        seen |= known & ~before
    return hidden & ~seen


def sweep_views(rig: Rig, near: float, far: float) -> list[Sweep]:
    """Sweep all views, coarse to fine; `near` and `far` are in widest baselines."""
    numbers = range(len(rig.images))
    guesses: list[Sweep | None] = [None] * len(rig.images)
    if min(min(image.size) for image in rig.images) >= MIN_GUIDED_SIDE:
        guesses = [*sweep_views(rig.halve(), near, far)]
    searches = [
        plan_search(number, rig, near, far, guess)
        for number, guess in zip(numbers, guesses, strict=True)
    ]
    found = get_depth_device(rig.device).find_planes(searches)
    sweeps = []
    for search, guess, (index, margin) in zip(searches, guesses, found, strict=True):
        if guess is not None:
            # A narrow band leaves out rivals of the best plane; the half-size sweep has seen them.
            margin = np.minimum(margin, repeat_pixels(guess.margin, search.reference.size))
        sweeps.append(Sweep(search.planes, index, margin))
    return sweeps


def plan_search(number: int, rig: Rig, near: float, far: float, guess: Sweep | None) -> PlaneSearch:
    """Plan which planes of one view are matched: near the half-size `guess` if there is one."""
    image = rig.images[number]
    others = rig.neighbours.neighbours_of[number]
    sources = [(rig.images[i], rig.transforms[number, i]) for i in others]
    planes = place_planes(image, sources, near, far)
    bands = make_full_bands(image.size, len(planes))
    if guess is not None:
        likely = compute_plane_index(planes, guess.inverse)
        bands = make_guided_bands(likely, 2, image.size, len(planes))

    # A given depth enters the costs before they are aggregated, so that it spreads to the pixels
    # around it (decision 046).
    given = compute_plane_index(planes, image.given).clip(0, len(planes) - 1)
    given = np.where(image.given > 0, given, np.float32(-1))
    return PlaneSearch(image, sources, planes, bands, given)


def place_planes(
    reference: StereoImage, sources: Sequence[Source], near: float, far: float
) -> Planes:
    """Space inverse depths evenly from far to near, without planes outside all sources.

    Evenly spaced inverse depths move a pixel by equal steps along its epipolar line, if the camera
    does not move forward. Their number is such that a step is about `MAX_PLANE_MOTION` pixels.
    """
    # A grid of 9 x 9 reference pixels stands for the image; 257 depths bound 256 steps.
    h, w = reference.size
    x, y = np.meshgrid(np.linspace(0.5, w - 0.5, 9), np.linspace(0.5, h - 0.5, 9))
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    samples = np.linspace(1 / far, 1 / near, 257)
    motion = np.zeros(256)
    overlap = np.zeros(257)
    for source, float_transform in sources:
        transform = float_transform.astype(np.float64)
        # Pixels of the grid in the source at each depth [257, 81, 3], homogeneous.
        moved = (pixels @ transform[:, :3].T)[None] + samples[:, None, None] * transform[:, 3]
        ratio = moved[..., 2]
        projected = moved[..., :2] / np.maximum(ratio, 1e-3)[..., None]
        H, W = source.size
        inside = (projected >= 0).all(-1) & (projected[..., 0] < W) & (projected[..., 1] < H)
        seen = (ratio > 1e-3) & inside
        # The motion of a step: 80 % of the pixels move less, in the source that moves most.
        steps = np.linalg.norm(np.diff(projected, axis=0), axis=-1)
        known = torch.from_numpy(np.where(seen[1:] & seen[:-1], steps, np.nan))
        usual = known.nanquantile(0.8, dim=1).nan_to_num().numpy()  # 0 where nothing is seen
        motion = np.maximum(motion, usual)
        overlap = np.maximum(overlap, seen.mean(axis=1))

    # The sweep ends at the nearest depth at which some source still shows enough of the grid. Where
    # none shows any, all depths stay.
    useful = np.flatnonzero(overlap >= MIN_SEEN_GRID)
    last = max(int(useful[-1]), MIN_USED_SAMPLES) if len(useful) else 256
    num_steps = float(motion[:last].sum()) / MAX_PLANE_MOTION
    num_planes = int(np.clip(np.ceil(num_steps), MIN_PLANES, MAX_PLANES))
    return np.linspace(samples[0], samples[last], num_planes).astype(np.float32)


def make_full_bands(size: tuple[int, int], planes: int) -> Bands:
    """Create bands with all planes for an image of `size` (height, width)."""
    shape = compute_tile_grid(size)
    return make_bands(np.zeros(shape, int), np.full(shape, planes), size)


def make_guided_bands(guess: Map, shrinkage: int, size: tuple[int, int], planes: int) -> Bands:
    """Create bands around the planes `guess` of an image `1 / shrinkage` the `size`."""
    likely = cv2.medianBlur(guess, MEDIAN_SIZE)
    # A tile also searches the depths that the guess has just outside of it.
    window = np.ones((2 * GUESS_MARGIN + 1, 2 * GUESS_MARGIN + 1), np.uint8)
    lowest = reduce_tiles(np.minimum, cv2.erode(likely, window), shrinkage, size)
    highest = reduce_tiles(np.maximum, cv2.dilate(likely, window), shrinkage, size)
    low = (np.floor(lowest).astype(int) - EXTRA_PLANES).clip(0, planes - 1)
    high = (np.ceil(highest).astype(int) + EXTRA_PLANES + 1).clip(1, planes)
    return make_bands(low, high, size)


def reduce_tiles(
    extreme: np.ufunc, values: Map, shrinkage: int, size: tuple[int, int]
) -> Float32[np.ndarray, "r c"]:
    """Reduce the values of each tile with `extreme` (minimum or maximum).

    Tiles are those of an image of `size`, and `values` an image of `1 / shrinkage` the size.
    """
    rows, columns = compute_tile_grid(size)
    tops = np.arange(rows) * TILE_ROWS // shrinkage
    lefts = np.arange(columns) * TILE_COLUMNS // shrinkage
    return extreme.reduceat(extreme.reduceat(values, tops, axis=0), lefts, axis=1)


def compute_tile_grid(size: tuple[int, int]) -> tuple[int, int]:
    """Count the rows and columns of tiles, with incomplete ones at the lower and right border."""
    height, width = size
    return -(-height // TILE_ROWS), -(-width // TILE_COLUMNS)


def make_bands(
    low: Int[np.ndarray, "r c"], high: Int[np.ndarray, "r c"], size: tuple[int, int]
) -> Bands:
    """Build one band per tile, from plane `low` up to but excluding `high`."""
    rows, columns = compute_tile_grid(size)
    heights = np.diff(np.append(np.arange(rows) * TILE_ROWS, size[0]))
    widths = np.diff(np.append(np.arange(columns) * TILE_COLUMNS, size[1]))
    costs = heights[:, None] * widths * (high - low)
    start = np.append(0, np.cumsum(costs, dtype=np.int64))
    return Bands(low.astype(np.int32), high.astype(np.int32), start)


def compute_inverse_depth(planes: Planes, index: Map) -> Map:
    """Convert plane indices to inverse depths, at most twice as far as the farthest plane.

    Indices are taken up to half a step beyond the first and the last plane.
    """
    step = planes[1] - planes[0]
    within = index.clip(-0.5, len(planes) - 0.5)
    return np.maximum(planes[0] + within * step, planes[0] / 2).astype(np.float32)


def compute_plane_index(planes: Planes, inverse: Map) -> Map:
    """Convert inverse depths to plane indices, below 0 and beyond the last plane, too."""
    return ((inverse - planes[0]) / (planes[1] - planes[0])).astype(np.float32)


def repeat_pixels(values: Map, size: tuple[int, int]) -> Map:
    """Repeat each pixel 2 x 2 and crop to `size`."""
    return np.ascontiguousarray(values.repeat(2, axis=0).repeat(2, axis=1)[: size[0], : size[1]])
