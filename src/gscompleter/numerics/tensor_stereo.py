"""Plane-sweep stereo as operations of torch, for a GPU.

The twin of `kernels/stereo.py`, whose terms it uses, and equal to it: tiles at planes are matched
many at a time, and rounded as the compiled loops round. Costs then lie in a volume [h, w, planes],
`OUTSIDE` at the planes outside the band of a pixel's tile. A volume, unlike a list of the costs in
bands, needs no look-up of where a neighbour's costs lie. It holds more, but a GPU waits for
launches rather than for arithmetic.

**Memory.** Of an image of 1920 x 1080 pixels with 256 planes, costs take 0.5 GiB and their sums 1
GiB; everything beside them is made in parts of about `PART_BYTES`, so that all stays below 2 GiB
(`estimate_search_bytes`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float32, Int16, Int64, UInt8
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.numerics.kernels.stereo import (
    AGGREGATION_PATHS,
    INFEASIBLE,
    TILE_COLUMNS,
    TILE_ROWS,
    UNSEEN,
)

OUTSIDE = 255
"""Cost of a plane outside the band of a pixel's tile, where no plane is `UNSEEN` any more."""
MOST_COST = 254
"""Largest cost of any other plane."""
PART_BYTES = 2**26
"""Bytes of one array of a part of a volume. Some four of such arrays are held at once."""
CELL_BYTES = 300
"""Most bytes that the matching of one pixel at one plane holds at once."""
IMAGE_BYTES = 110
"""Bytes for each pixel of the images, tiles and sources of one view while it is matched."""
JUMP_BYTES = 44
"""Bytes for each pixel of a view of the penalties of jumps, and of the planes that are found."""
LEAST_DEPTH_RATIO = 1e-3
"""Smallest z-depth in the source over that in the reference at which a point is projected."""

Volume = UInt8[Tensor, "h w planes"]
Sums = Int16[Tensor, "h w planes"]


@dataclass(frozen=True)
class CostRule:
    """How the colours of two windows are compared, and the costs of several sources combined."""

    radius: int
    """Radius of the windows, in pixels."""
    floor: float
    """Squared image noise, summed over a window of three colours; above 0. Weaker texture does not
    correlate."""
    detail: float
    """Share of the difference of the two pixels in the cost."""
    num_best: int
    """Number of first sources, of which the best counts; further ones cover what these miss."""
    covering_penalty: int
    """Additional cost in a further source where one of the first sees the plane."""
    unseen_cost: int
    """Cost where no source sees the plane."""


class JumpPenalties(NamedTuple):
    """Penalties of a jump between neighbouring pixels of several views, int16."""

    right: Int16[Tensor, "views h w-1"]
    """To the right neighbour."""
    down: Int16[Tensor, "views h-1 w"]
    """To the lower neighbour."""
    down_right: Int16[Tensor, "views h-1 w-1"]
    """To the lower right neighbour."""
    down_left: Int16[Tensor, "views h-1 w-1"]
    """From the right neighbour of a pixel to the one below the pixel."""


class TiledImage(NamedTuple):
    """The windows of the reference image, by tile."""

    colors: Float32[Tensor, "3 tiles tall wide"]
    """Tiles with `radius` pixels around them; the border of the image is repeated."""
    means: Float32[Tensor, "3 tiles rows columns"]
    variances: Float32[Tensor, "tiles rows columns"]
    """Squared deviations from the means, summed over windows and colours."""


class TilePlanes(NamedTuple):
    """Pairs of a tile and a plane that it is matched at."""

    row: Int64[Tensor, "pairs"]
    column: Int64[Tensor, "pairs"]
    """Row and column of the tile among the tiles."""
    plane: Int64[Tensor, "pairs"]

    def take(self, part: slice) -> TilePlanes:
        """Take some of the pairs."""
        return TilePlanes(*(values[part] for values in self))


class MatchedSource(NamedTuple):
    """Another image, and where pixels of the reference lie in it."""

    pixels: Float32[Tensor, "3 pixels"]
    size: tuple[int, int]
    """Height and width."""
    transform: Float32[Tensor, "3 4"]
    """[A | b] as of the kernels."""


def split_length(length: int, longest: int) -> Iterator[slice]:
    """Split a length into parts that are at most `longest`, or of one element."""
    step = max(1, longest)
    for begin in range(0, length, step):
        yield slice(begin, min(begin + step, length))


def estimate_search_bytes(size: tuple[int, int], num_planes: int, num_views: int) -> int:
    """Estimate the most bytes that costs, paths and best planes of views of one size take at once.

    `size` is the height and width of their images, whose costs are stacked and summed together.
    """
    height, width = size
    pixels = height * width
    padded_rows = -(-height // TILE_ROWS) * TILE_ROWS
    padded_columns = -(-width // TILE_COLUMNS) * TILE_COLUMNS
    # One byte for each cost. Those of one view are not copied, those of several are stacked.
    cells = padded_rows * padded_columns * num_planes
    volumes = num_views * cells
    stacked = num_views * pixels * num_planes if num_views > 1 else 0
    # Windows of a small image, which is one part, reach beyond its tiles.
    matching = volumes + IMAGE_BYTES * pixels + min(8 * PART_BYTES, 2 * CELL_BYTES * cells)
    # Sums are of two bytes. Two rows of three paths, in two directions, have planes at both ends.
    sums = 2 * num_views * pixels * num_planes
    states = 2 * 2 * 2 * 3 * num_views * (width + 2) * (num_planes + 2)
    jumps = JUMP_BYTES * num_views * pixels
    parts = 3 * min(PART_BYTES, 4 * num_views * pixels * num_planes)
    summing = volumes + stacked + sums + states + jumps + parts
    return max(matching, summing)


def compute_cost_volume(
    reference: Float32[Tensor, "h w 3"],
    sources: Sequence[MatchedSource],
    inverse_depths: Float32[Tensor, "planes"],
    pairs: TilePlanes,
    num_planes: int,
    rule: CostRule,
) -> UInt8[Tensor, "h w {num_planes}"]:
    """Compute the matching costs of the tiles of an image at their planes, in a volume of so many.

    Equal to `compute_matching_costs` of the kernels, and to what the sweep makes of several
    sources. Where a compiler rounds otherwise, few costs differ, by one.
    """
    h, w, _ = reference.shape
    tiled = tile_image(reference, rule.radius)
    rows, columns = -(-h // TILE_ROWS), -(-w // TILE_COLUMNS)
    volume = reference.new_full(
        (rows, TILE_ROWS, columns, TILE_COLUMNS, num_planes), OUTSIDE, dtype=torch.uint8
    )
    pixels = tiled.colors[0, 0].numel()
    for part in split_length(len(pairs.plane), 8 * PART_BYTES // (CELL_BYTES * pixels)):
        matched = pairs.take(part)
        costs = [
            match_tiles(tiled, source, inverse_depths, matched, columns, rule) for source in sources
        ]
        row, column, plane = matched
        volume[row, :, column, :, plane] = combine_costs(costs, rule)
    return volume.reshape(rows * TILE_ROWS, columns * TILE_COLUMNS, -1)[:h, :w]


def multiply_add(a: Tensor, b: Tensor | float, c: Tensor | float) -> Tensor:
    """Compute a b + c with a single rounding to float32, as processors do for compiled loops.

    Not with `addcmul`, since it depends on the device whether that rounds once or twice. The
    product is exact in double precision.
    """
    return (a.double() * b + c).float()


def multiply_colors(a: Float32[Tensor, "3 *n"], b: Float32[Tensor, "3 *n"]) -> Tensor:
    """Sum the products of three colours, rounded as the compiled loop does."""
    first = multiply_add(a[0], b[0], a[1] * b[1])
    return multiply_add(a[2], b[2], first)


def tile_image(image: Float32[Tensor, "h w 3"], radius: int) -> TiledImage:
    """Cut an image into tiles, and measure means and variances of the windows of their pixels."""
    h, w, _ = image.shape
    missing_rows = -h % TILE_ROWS
    missing_columns = -w % TILE_COLUMNS
    border = [radius, radius + missing_columns, radius, radius + missing_rows]
    padded = pad(image.permute(2, 0, 1)[None], border, mode="replicate")[0]
    tiles = padded.unfold(1, TILE_ROWS + 2 * radius, TILE_ROWS)
    colors = tiles.unfold(2, TILE_COLUMNS + 2 * radius, TILE_COLUMNS).flatten(1, 2)
    sums = sum_windows(torch.cat([colors, multiply_colors(colors, colors)[None]]), radius)
    # Divided by a tensor, as the reciprocal of a number would round otherwise.
    area = (2 * radius + 1) ** 2
    means = sums[:3] / torch.full_like(sums[:1], area)
    variances = sums[3]
    # Sum of squared deviations: sum of squares less n mean².
    for mean in means:
        variances = multiply_add(-area * mean, mean, variances)
    return TiledImage(colors, means, variances)


def sum_windows(
    values: Float32[Tensor, "*n tall wide"], radius: int
) -> Float32[Tensor, "*n rows columns"]:
    """Sum values over windows of (2 radius + 1)² pixels, by running sums as the kernel.

    Other sums would round otherwise, and small differences of large sums are what counts.
    """
    tall, wide = values.shape[-2:]
    rows = tall - 2 * radius
    columns = wide - 2 * radius
    running = torch.zeros_like(values[..., 0, :])
    for y in range(2 * radius):
        running += values[..., y, :]
    of_columns = values.new_empty((*values.shape[:-2], rows, wide))
    for y in range(rows):
        torch.add(running, values[..., y + 2 * radius, :], out=of_columns[..., y, :])
        torch.sub(of_columns[..., y, :], values[..., y, :], out=running)
    sums = of_columns[..., :columns].clone()
    for x in range(1, 2 * radius + 1):
        sums += of_columns[..., x : x + columns]
    return sums


def match_tiles(
    tiled: TiledImage,
    source: MatchedSource,
    inverse_depths: Float32[Tensor, "planes"],
    pairs: TilePlanes,
    columns: int,
    rule: CostRule,
) -> UInt8[Tensor, "pairs rows columns"]:
    """Compute the costs of tiles at planes in one source; `UNSEEN` outside of it.

    `columns` is the number of tiles beside each other.
    """
    radius = rule.radius
    area = (2 * radius + 1) ** 2
    tile = pairs.row * columns + pairs.column
    own = tiled.colors[:, tile]
    own_means = tiled.means[:, tile]
    own_variance = tiled.variances[tile]
    warped, is_seen = warp_to_tiles(own.shape[2:], source, inverse_depths, pairs, radius)
    products = [multiply_colors(warped, warped), multiply_colors(warped, own)]
    sums = sum_windows(torch.cat([warped, torch.stack(products)]), radius)
    means = sums[:3] / torch.full_like(sums[:1], area)
    variance = sums[3]
    covariance = sums[4]
    inner = slice(radius, -radius or None)
    own = own[:, :, inner, inner]
    warped = warped[:, :, inner, inner]
    difference = torch.zeros_like(variance)
    for color in range(3):
        difference += (warped[color] - means[color] - (own[color] - own_means[color])).abs()
        weighted = -area * means[color]
        variance = multiply_add(weighted, means[color], variance)
        covariance = multiply_add(weighted, own_means[color], covariance)

    # Zero-mean normalised cross-correlation over all three colours together.
    spread = (variance.clamp_min(0) + rule.floor) * (own_variance.clamp_min(0) + rule.floor)
    correlation = covariance / spread.sqrt()
    detail = torch.full_like(correlation, rule.detail)
    # Both terms are 1 for a mismatch, as in the kernel.
    cost = multiply_add(detail, (difference * 5).clamp_max(1), (1 - detail) * (1 - correlation))
    levels = (cost * MOST_COST).clamp(0, MOST_COST).to(torch.uint8)
    return levels.where(is_seen[:, inner, inner], UNSEEN)


def warp_to_tiles(
    size: Sequence[int],
    source: MatchedSource,
    inverse_depths: Float32[Tensor, "planes"],
    pairs: TilePlanes,
    radius: int,
) -> tuple[Float32[Tensor, "3 pairs tall wide"], Bool[Tensor, "pairs tall wide"]]:
    """Sample a source where the pixels of tiles, and `radius` around them, are at planes.

    Also tell which of them lie in the source.
    """
    tall, wide = size
    H, W = source.size
    within = torch.arange(max(tall, wide), dtype=torch.float32, device=pairs.row.device)
    x = (pairs.column * TILE_COLUMNS)[:, None] + (within[:wide] - radius) + 0.5
    y = (pairs.row * TILE_ROWS)[:, None] + (within[:tall] - radius) + 0.5
    # A (x, y, 1) + b w, of which the part without x is constant along the row.
    a = source.transform[:, :, None, None]
    inverse_depth = inverse_depths[pairs.plane][:, None]
    of_row = multiply_add(a[:, 3], inverse_depth, multiply_add(a[:, 1], y, a[:, 2]))
    projected = multiply_add(a[:, 0, :, :, None], x[:, None], of_row[..., None])
    ratio = projected[2]
    inverse = 1 / ratio.clamp_min(LEAST_DEPTH_RATIO)
    x, y = multiply_add(projected[:2], inverse, -0.5)
    is_seen = ratio > LEAST_DEPTH_RATIO
    is_seen = is_seen & (x >= -0.5) & (x <= W - 0.5) & (y >= -0.5) & (y <= H - 0.5)

    # NaN becomes 0, so that every index lies within the source. The last pixel is read as the
    # second of a pair, with weight 1.
    x = x.where(x > 0, 0.0).clamp_max(W - 1)
    y = y.where(y > 0, 0.0).clamp_max(H - 1)
    left = x.to(torch.int64).clamp_max(W - 2)
    top = y.to(torch.int64).clamp_max(H - 2)
    x = x - left
    y = y - top
    place = top * W + left
    w11 = x * y
    w01 = x - w11
    w10 = y - w11
    w00 = 1 - x - w10
    upper_left = source.pixels[:, place]
    upper_right = source.pixels[:, place + 1]
    # The compiler rounds the first product of two colours, and the second one of blue.
    upper = torch.cat(
        [
            multiply_add(w01, upper_right[:2], w00 * upper_left[:2]),
            multiply_add(w00, upper_left[2:], w01 * upper_right[2:]),
        ]
    )
    three = multiply_add(w10, source.pixels[:, place + W], upper)
    return multiply_add(w11, source.pixels[:, place + (W + 1)], three), is_seen


def combine_costs(
    costs: Sequence[UInt8[Tensor, "pairs rows columns"]], rule: CostRule
) -> UInt8[Tensor, "pairs rows columns"]:
    """Combine the costs of several sources: the best of the first, and what others cover."""
    best = torch.stack(list(costs[: rule.num_best])).amin(dim=0)
    for covering in costs[rule.num_best :]:
        dearer = covering.clamp_max(MOST_COST - rule.covering_penalty) + rule.covering_penalty
        best = covering.where(best == UNSEEN, torch.minimum(best, dearer))
    return best.where(best != UNSEEN, rule.unseen_cost)


def prefer_given_planes(
    volume: Volume, given: Float32[Tensor, "h w"], weight: float, step: float
) -> None:
    """Make planes beside given depths cost more, in place, as `prefer_given` of the kernels."""
    h, w, count = volume.shape
    planes = torch.arange(count, dtype=torch.float32, device=volume.device)
    for rows in split_length(h, PART_BYTES // (w * count * 4)):
        costs = volume[rows]
        beside = ((planes - given[rows, :, None]).abs() - 0.5).clamp_min(0)
        dearer = (weight * costs + step * beside).clamp_max(MOST_COST).to(torch.uint8)
        is_given = (given[rows, :, None] >= 0) & (costs != OUTSIDE)
        volume[rows] = dearer.where(is_given, costs)


def aggregate_volumes(
    volumes: UInt8[Tensor, "views h w planes"], jumps: JumpPenalties, small: int
) -> Int16[Tensor, "views h w planes"]:
    """Sum costs along eight paths (Hirschmüller 2008), exactly as the kernels do.

    Every step of a path waits for the one before, so that there are eight launches for each row and
    for each column, of all views at once. `small` is the penalty of one plane. Sums outside the
    bands mean nothing.
    """
    totals = torch.zeros(volumes.shape, dtype=torch.int16, device=volumes.device)
    right, down, down_right, down_left = jumps
    # Penalties [views, paths, rows, columns] on the way to a row from the row before: from the
    # left, from above and from the right. Where nothing is before, at the sides, they are not used.
    downwards = torch.stack([pad(down_right, (1, 0)), down, pad(down_left, (0, 1))], dim=1)
    upwards = torch.stack([pad(down_left, (1, 0)), down, pad(down_right, (0, 1))], dim=1)
    add_paths(volumes, totals, torch.stack([downwards, upwards.flip(2)]), small)
    along = right.transpose(1, 2)[:, None]
    add_paths(
        volumes.transpose(1, 2),
        totals.transpose(1, 2),
        torch.stack([along, along.flip(2)]),
        small,
    )
    return totals


def add_paths(
    volumes: UInt8[Tensor, "views rows lanes planes"],
    totals: Int16[Tensor, "views rows lanes planes"],
    penalties: Int16[Tensor, "2 views paths rows-1 lanes"],
    small: int,
) -> None:
    """Add to totals the sums along paths from row to row, down and up at once, in place.

    A path comes from the same lane of the row before, or there are three, from the lanes beside it,
    too. `penalties` are those of jumps to row 1, 2, ... on the way down, and to the last row but
    one, ... on the way up.
    """
    views, rows, lanes, count = volumes.shape
    paths = penalties.shape[2]
    side = paths // 2
    shape = 2, views, paths, lanes + 2 * side, count + 2
    # Costs of the row before and of this one, which take turns, less the lowest cost of each pixel.
    # Beyond the sides no path comes from anywhere, and beyond the planes nothing can be.
    states = [totals.new_zeros(shape) for _ in range(2)]
    inner = [state[..., side : lanes + side, 1:-1] for state in states]
    # Path k at lane x reads lane x + k of the padded row before, which is lane x + k - side.
    before = [
        state.as_strided(
            (2, views, paths, lanes, count + 2),
            (*state.stride()[:2], state.stride(2) + state.stride(3), *state.stride()[3:]),
        )
        for state in states
    ]
    neighbours = [(all_of[..., :-2], all_of[..., 2:], all_of[..., 1:-1]) for all_of in before]
    ceilings = penalties.movedim(3, 0)[..., None]
    lowest = totals.new_empty((2, views, paths, lanes, 1))
    for part in split_length(rows, PART_BYTES // (2 * views * lanes * count * 2)):
        mirrored = slice(rows - part.stop, rows - part.start)
        costs = torch.stack([volumes[:, part], volumes[:, mirrored].flip(1)]).to(torch.int16)
        costs = costs.masked_fill_(costs == OUTSIDE, int(INFEASIBLE)).movedim(2, 0)[:, :, :, None]
        sums = totals.new_empty((len(costs), 2, views, lanes, count))
        for number in range(len(costs)):
            row = part.start + number
            now = row % 2
            reached = inner[now]
            if row > 0:
                # Hirschmüller's recursion, see `_advance_path` of the kernels.
                below, above, same = neighbours[1 - now]
                torch.minimum(below, above, out=reached)
                reached += small
                torch.minimum(reached, same, out=reached)
                torch.minimum(reached, ceilings[row - 1], out=reached)
                reached += costs[number]
            else:
                reached.copy_(costs[number].expand_as(reached))
            if row < 2:
                for beyond in (0, -1):
                    states[now][..., side : lanes + side, beyond] = int(INFEASIBLE)
            torch.sum(reached, dim=2, dtype=torch.int16, out=sums[number])
            torch.amin(reached, dim=-1, keepdim=True, out=lowest)
            reached -= lowest
        totals[:, part].add_(sums[:, 0].transpose(0, 1))
        totals[:, mirrored].add_(sums[:, 1].transpose(0, 1).flip(1))


def select_volume_planes(
    totals: Sums, volume: Volume, low: Int16[Tensor, "h w"], high: Int16[Tensor, "h w"]
) -> Float32[Tensor, "2 h w"]:
    """Select the best plane of every pixel, with fraction, and its margin, exactly as the kernels.

    `volume` tells the planes outside the bands from `low` to `high`.
    """
    h, w, count = totals.shape
    found = torch.empty((2, h, w), dtype=torch.float32, device=totals.device)
    planes = torch.arange(count, dtype=torch.int16, device=totals.device)
    for rows in split_length(h, PART_BYTES // (w * count * 2)):
        sums = totals[rows].masked_fill(volume[rows] == OUTSIDE, int(INFEASIBLE))
        best = sums.argmin(dim=-1, keepdim=True)
        least = sums.gather(-1, best)
        # Neighbours of the best plane are the same surface, and no rivals.
        rivals = sums.masked_fill((planes - best.to(torch.int16)).abs() <= 2, int(INFEASIBLE)).amin(
            dim=-1
        )
        found[1, rows] = (rivals - least[..., 0]) / AGGREGATION_PATHS

        # Two lines of opposite gradient, as in the kernel.
        before = (sums.gather(-1, (best - 1).clamp_min(0)) - least)[..., 0]
        after = (sums.gather(-1, (best + 1).clamp_max(count - 1)) - least)[..., 0]
        steeper = torch.maximum(before, after)
        at = best[..., 0]
        is_between = (at > low[rows]) & (at < high[rows] - 1) & (steeper > 0)
        fraction = 0.5 * (before - after) / steeper
        found[0, rows] = at + fraction.where(is_between, 0.0)
    return found
