"""Plane-sweep stereo: matching costs, semi-global aggregation, and consistency checks.

Pixel centres are at +0.5. A 3 x 4 `transform` [A | b] maps pixel (x, y, 1) of one view at inverse
depth w to the homogeneous pixel A (x, y, 1) + b w of another; its third entry is the z-depth there
over that in the first view. A plane is one inverse depth, parallel to the image of the reference
view, and planes are numbered from far to near. Images have three colours in [0, 1] and at least
2 x 2 pixels. Arrays are float32 unless their dtype is told.
"""

from typing import NamedTuple

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.parallel import run_calls, share

UNSEEN = 255
"""Cost of a plane at which the pixel falls outside the other image."""
TILE_ROWS = 16
TILE_COLUMNS = 64
"""Size of a tile in pixels: what is matched at once stays in the cache."""
INFEASIBLE = np.int16(16000)
"""Cost of what cannot be, above all sums of costs. Penalties on top of it do not overflow int16."""
AGGREGATION_PATHS = 8
"""Number of paths of semi-global aggregation."""


class Bands(NamedTuple):
    """The planes that each tile of an image is matched at.

    They are narrow where a half-size sweep has found the likely ones. Costs [n] of all pixels at
    the planes of their tiles are in one array, ordered by tile, then row, pixel and plane. Tiles at
    the right and lower border may be incomplete.
    """

    low: np.ndarray
    """First plane of each tile [rows, columns] int32."""
    high: np.ndarray
    """One past the last plane of each tile [rows, columns] int32."""
    start: np.ndarray
    """Offset of the costs of each tile, row by row, and at last n [tiles + 1] int64."""


@njit(inline="always")
def _get_first_cost(bands, y, x, width):
    """Return the index of a pixel's first cost, in an image that is `width` pixels wide."""
    row, column = y // TILE_ROWS, x // TILE_COLUMNS
    left = column * TILE_COLUMNS
    tile_width = min(TILE_COLUMNS, width - left)
    within = (y - row * TILE_ROWS) * tile_width + x - left
    planes = bands.high[row, column] - bands.low[row, column]
    return bands.start[row * bands.low.shape[1] + column] + within * planes


@njit(fastmath={"contract"}, inline="always")
def _clip(value, low, high):
    """Clip to [low, high]; NaN becomes low, since the result is used as an index."""
    value = value if value > low else low
    return value if value < high else high


@njit(fastmath={"contract"})
def _sum_boxes(values, sums, column, rows, width, radius):
    """Sum `values` over windows of (2 radius + 1)^2 pixels into `sums`.

    values [rows + 2 radius, width + 2 radius], sums [rows, width]. column [at least as wide as
    values] is scratch: running sums of 2 radius + 1 rows.
    """
    for x in range(width + 2 * radius):
        column[x] = np.float32(0)
    for y in range(2 * radius):
        for x in range(width + 2 * radius):
            column[x] += values[y, x]
    for y in range(rows):
        for x in range(width + 2 * radius):
            column[x] += values[y + 2 * radius, x]
        # One pass over the row per column of the window, since a pass is vectorised.
        for x in range(width):
            sums[y, x] = column[x]
        for dx in range(1, 2 * radius + 1):
            for x in range(width):
                sums[y, x] += column[x + dx]
        for x in range(width + 2 * radius):
            column[x] -= values[y, x]


def compute_matching_costs(
    reference, source, transform, inverse_depths, bands, radius, noise, detail
):
    """Compute matching costs [n] uint8, 0 to 254, of the reference pixels at the planes of `bands`.

    Normalised cross-correlation of windows over all colours, which ignores exposure, is mixed with
    the difference of the two pixels from their windows' means, which is sharper at edges. Planes
    outside the source cost UNSEEN.

    reference [h, w, 3] and source [H, W, 3]: images. transform [3, 4]: from reference to source.
    inverse_depths [d]: those of all planes. radius: of the windows, in pixels. noise: standard
    deviation of image noise, above 0; weaker texture does not correlate. detail: share of the
    second term.
    """
    costs = np.empty(bands.start[-1], np.uint8)
    given = (reference, source, transform, inverse_depths, bands)
    share(_match_tiles, bands.low.size, *given, radius, noise, detail, costs)
    return costs


@njit(fastmath={"contract"}, error_model="numpy", inline="always")
def _compare(y, own, own_mean, other, other_mean, other_square, cross, line):
    """Turn the window sums of row y into deviations and products, in place.

    `other_mean` has sums before, and means after. `other_square` and `cross` have sums of squares
    and products before, and of those of deviations from the means after. line[0] gets the
    differences of the two pixels from their windows' means, summed over the colours.
    """
    cols = cross.shape[1]
    radius = (own.shape[2] - cols) // 2
    area = np.float32((2 * radius + 1) ** 2)
    for x in range(cols):
        line[0, x] = np.float32(0)
    for c in range(3):
        for x in range(cols):
            other_mean[c, y, x] /= area
        for x in range(cols):
            theirs = other[c, y + radius, x + radius] - other_mean[c, y, x]
            line[0, x] += abs(theirs - (own[c, y + radius, x + radius] - own_mean[c, y, x]))
        for x in range(cols):
            other_square[y, x] -= area * other_mean[c, y, x] * other_mean[c, y, x]
        for x in range(cols):
            cross[y, x] -= area * other_mean[c, y, x] * own_mean[c, y, x]


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def _match_tiles(
    begin, end, reference, source, transform, inverse_depths, bands, radius, noise, detail, costs
):
    height, width = reference.shape[:2]
    H, W = source.shape[:2]
    columns = bands.low.shape[1]
    area = np.float32((2 * radius + 1) ** 2)
    # Squared noise, summed over a window of three colours; it damps correlations of weak texture.
    floor = np.float32(3) * area * noise * noise
    for tile in range(begin, end):
        top, left = tile // columns * TILE_ROWS, tile % columns * TILE_COLUMNS
        low = bands.low[tile // columns, tile % columns]
        count = bands.high[tile // columns, tile % columns] - low
        rows, cols = min(TILE_ROWS, height - top), min(TILE_COLUMNS, width - left)
        tall, wide = rows + 2 * radius, cols + 2 * radius
        own = np.empty((3, tall, wide), np.float32)
        other = np.empty((3, tall, wide), np.float32)
        product = np.empty((tall, wide), np.float32)
        own_mean = np.empty((3, rows, cols), np.float32)
        other_mean = np.empty((3, rows, cols), np.float32)
        own_square = np.empty((rows, cols), np.float32)
        other_square = np.empty((rows, cols), np.float32)
        cross = np.empty((rows, cols), np.float32)
        seen = np.empty((tall, wide), np.bool_)
        column = np.empty(wide, np.float32)
        # Values of one row at a time: where its pixels are in the source, then differences, then
        # costs.
        line = np.empty((2, wide), np.float32)
        # The reference window sums are the same at all planes: computed once, with a border of
        # `radius` pixels around the tile.
        for y in range(tall):
            for x in range(wide):
                yy = _clip(top + y - radius, 0, height - 1)
                xx = _clip(left + x - radius, 0, width - 1)
                total = np.float32(0)
                for c in range(3):
                    own[c, y, x] = reference[yy, xx, c]
                    total += own[c, y, x] * own[c, y, x]
                product[y, x] = total
        for c in range(3):
            _sum_boxes(own[c], own_mean[c], column, rows, cols, radius)
        _sum_boxes(product, own_square, column, rows, cols, radius)
        # Sum of squared deviations: Σ a² - n mean².
        for y in range(rows):
            for x in range(cols):
                for c in range(3):
                    own_mean[c, y, x] /= area
                    own_square[y, x] -= area * own_mean[c, y, x] * own_mean[c, y, x]

        # Each plane: the source is warped to the tile, its windows are summed and compared.
        first = bands.start[tile]
        for plane in range(count):
            # Warp: A (x, y, 1) + b w, of which the part without x is constant along the row.
            w = inverse_depths[low + plane]
            for y in range(tall):
                py = np.float32(top + y - radius) + np.float32(0.5)
                q0 = transform[0, 1] * py + transform[0, 2] + transform[0, 3] * w
                q1 = transform[1, 1] * py + transform[1, 2] + transform[1, 3] * w
                q2 = transform[2, 1] * py + transform[2, 2] + transform[2, 3] * w
                for x in range(wide):
                    px = np.float32(left + x - radius) + np.float32(0.5)
                    ratio = q2 + transform[2, 0] * px
                    inverse = np.float32(1) / max(ratio, np.float32(1e-3))
                    sx = (q0 + transform[0, 0] * px) * inverse - np.float32(0.5)
                    sy = (q1 + transform[1, 0] * px) * inverse - np.float32(0.5)
                    seen[y, x] = (
                        (ratio > np.float32(1e-3))
                        & (sx >= np.float32(-0.5))
                        & (sx <= np.float32(W) - np.float32(0.5))
                        & (sy >= np.float32(-0.5))
                        & (sy <= np.float32(H) - np.float32(0.5))
                    )
                    line[0, x] = _clip(sx, np.float32(0), np.float32(W - 1))
                    line[1, x] = _clip(sy, np.float32(0), np.float32(H - 1))
                for x in range(wide):
                    sx, sy = line[0, x], line[1, x]
                    # `_clip` ensures 0..W - 1 and 0..H - 1 for any input. The last pixel is read
                    # as the second of a pair, with weight 1.
                    ix = np.uint32(min(np.int32(sx), W - 2))
                    iy = np.uint32(min(np.int32(sy), H - 2))
                    ax, ay = sx - np.float32(ix), sy - np.float32(iy)
                    # Bilinear weights, from one product.
                    w11 = ax * ay
                    w01 = ax - w11
                    w10 = ay - w11
                    w00 = np.float32(1) - ax - w10
                    for c in range(3):
                        other[c, y, x] = (
                            w00 * source[iy, ix, c]
                            + w01 * source[iy, ix + 1, c]
                            + w10 * source[iy + 1, ix, c]
                            + w11 * source[iy + 1, ix + 1, c]
                        )
            for c in range(3):
                _sum_boxes(other[c], other_mean[c], column, rows, cols, radius)
            for y in range(tall):
                for x in range(wide):
                    a = other[0, y, x]
                    b = other[1, y, x]
                    c = other[2, y, x]
                    product[y, x] = a * a + b * b + c * c
            _sum_boxes(product, other_square, column, rows, cols, radius)
            for y in range(tall):
                for x in range(wide):
                    product[y, x] = (
                        other[0, y, x] * own[0, y, x]
                        + other[1, y, x] * own[1, y, x]
                        + other[2, y, x] * own[2, y, x]
                    )
            _sum_boxes(product, cross, column, rows, cols, radius)
            for y in range(rows):
                place = first + y * cols * count + plane
                _compare(y, own, own_mean, other, other_mean, other_square, cross, line)
                for x in range(cols):
                    # Zero-mean normalised cross-correlation over all three channels together.
                    correlation = cross[y, x] / np.sqrt(
                        (max(other_square[y, x], np.float32(0)) + floor)
                        * (max(own_square[y, x], np.float32(0)) + floor)
                    )
                    # Both terms are 1 for a mismatch: no correlation, or deviations from the means
                    # that differ by 0.2 or more, summed over three colours in [0, 1].
                    cost = (np.float32(1) - detail) * (np.float32(1) - correlation)
                    cost += detail * min(line[0, x] * np.float32(5), np.float32(1))
                    line[0, x] = min(cost * np.float32(254), np.float32(254))
                for x in range(cols):
                    value = np.uint8(line[0, x])
                    if not seen[y + radius, x + radius]:
                        value = np.uint8(UNSEEN)
                    costs[place + x * count] = value


def prefer_given(costs, bands, given, weight, step):
    """Make planes beside given depths cost more, in place; within half a plane matching decides.

    costs [n] uint8, none of them UNSEEN. given [h, w]: plane of each pixel with its fraction, or
    less than 0 if unknown. weight: of the matching cost there. step: cost of each further plane.
    """
    share(_prefer_given, len(given), costs, bands, given, weight, step)


@njit(nogil=True, fastmath={"contract"})
def _prefer_given(begin, end, costs, bands, given, weight, step):
    w = given.shape[1]
    for y in range(begin, end):
        for x in range(w):
            if given[y, x] < 0:
                continue
            first = _get_first_cost(bands, y, x, w)
            row, column = y // TILE_ROWS, x // TILE_COLUMNS
            low = bands.low[row, column]
            for k in range(bands.high[row, column] - low):
                beside = max(
                    abs(np.float32(low + k) - given[y, x]) - np.float32(0.5), np.float32(0)
                )
                cost = weight * np.float32(costs[first + k]) + step * beside
                costs[first + k] = np.uint8(min(cost, np.float32(254)))


@njit(fastmath={"contract"}, inline="always")
def _advance_path(cost, before, lowest, after, total, small, large):
    """Advance a path by one pixel and return its lowest cost there.

    cost [planes] uint8: of this pixel. before, after [at least planes + 2] int16: costs of the path
    at the pixel before and at this one, with a border of one plane on either side. lowest: least of
    those before. total [planes] int16: sum of all paths, to which this one is added. small, large:
    penalties of one plane and of a jump.
    """
    # Hirschmüller's recursion: L(p, d) = C(p, d) + min(L(q, d), L(q, d ± 1) + small,
    # min L(q) + large) - min L(q), with q the pixel before p on the path. Subtracting the lowest
    # cost before bounds L, so that it fits into 16 bits.
    planes = cost.shape[0]
    ceiling = np.int16(lowest + large)
    best = INFEASIBLE
    for k in range(planes):
        beside = np.int16(min(before[k], before[k + 2]) + small)
        reached = min(beside, min(before[k + 1], ceiling))
        value = np.int16(np.int16(cost[k]) + np.int16(reached - lowest))
        after[k + 1] = value
        total[k] = np.int16(total[k] + value)
        best = min(best, value)
    after[0] = INFEASIBLE
    after[planes + 1] = INFEASIBLE
    return best


@njit(inline="always")
def _align_bands(before, band_before, band, scratch):
    """Align the costs of a path in another tile to the planes of this one.

    `band_before` and `band` are the first plane and the end of both. Planes that the other tile
    does not have are INFEASIBLE. Returns `before` itself for the same band, or else `scratch`.
    """
    if band_before[0] == band[0] and band_before[1] == band[1]:
        return before
    for plane in range(band[0] - 1, band[1] + 1):
        known = band_before[0] <= plane < band_before[1]
        scratch[plane - band[0] + 1] = before[plane - band_before[0] + 1] if known else INFEASIBLE
    return scratch


@njit(nogil=True, fastmath={"contract"})
def _sweep_half(costs, bands, large_x, large_y, large_d, large_u, small, down, total):
    """Aggregate four of the eight paths: along the row, and three from the row before.

    `down` is True for those that lead right and down, and False for their reverse: left and up.
    `total` [n] int16 is the sum of the four.
    """
    h, w = large_y.shape[0] + 1, large_x.shape[1] + 1
    widest = 2
    for width in (bands.high - bands.low).flat:
        widest = max(widest, width + 2)
    # Costs of the row before and of this one, which take turns, and the lowest cost of each pixel,
    # for the three paths that come from the row before; `along` is for the path along the row.
    rows = np.zeros((2, 3, w, widest), np.int16)
    lows = np.zeros((2, 3, w), np.int16)
    along = np.zeros((2, widest), np.int16)
    nothing = np.zeros(widest, np.int16)
    scratch = np.empty(widest, np.int16)
    for num_done in range(h):
        y = num_done if down else h - 1 - num_done
        now = num_done % 2
        then = 1 - now
        row, row_before = y // TILE_ROWS, (y - 1 if down else min(y + 1, h - 1)) // TILE_ROWS
        # The row before lies at y - 1 on the way down and at y + 1 on the way up.
        upper = max(y - 1, 0) if down else min(y, h - 2)
        of_left, of_right = (large_d, large_u) if down else (large_u, large_d)
        low_along = np.int16(0)
        for s in range(w):
            x = s if down else w - 1 - s
            column = x // TILE_COLUMNS
            low, high = bands.low[row, column], bands.high[row, column]
            first = _get_first_cost(bands, y, x, w)
            end = first + high - low
            cost = costs[first:end]
            out = total[first:end]
            before = nothing
            edge = 0
            if s > 0:
                back = x - 1 if down else x + 1
                edge = min(x, back)
                tile = back // TILE_COLUMNS
                band = bands.low[row, tile], bands.high[row, tile]
                before = _align_bands(along[s % 2], band, (low, high), scratch)
            low_along = _advance_path(
                cost, before, low_along, along[1 - s % 2], out, small, large_x[y, edge]
            )
            from_left = of_left[upper, max(x - 1, 0)]
            from_right = of_right[upper, min(x, w - 2)]
            larges = (from_left, large_y[upper, x], from_right)
            for path in range(3):
                before = nothing
                lowest = np.int16(0)
                other = x + path - 1
                if num_done > 0 and 0 <= other < w:
                    tile = other // TILE_COLUMNS
                    band = bands.low[row_before, tile], bands.high[row_before, tile]
                    lowest = lows[then, path, other]
                    states = rows[then, path, other]
                    before = _align_bands(states, band, (low, high), scratch)
                lows[now, path, x] = _advance_path(
                    cost, before, lowest, rows[now, path, x], out, small, larges[path]
                )


def aggregate_semi_globally(costs, bands, large_x, large_y, large_d, large_u, small):
    """Sum costs [n] uint8 along eight paths (Hirschmüller 2008) to totals [n] int16.

    Planes missing in the previous tile are reached by a jump. small: penalty of one plane, int16.
    large_x [h, w - 1], large_y [h - 1, w], large_d and large_u [h - 1, w - 1]: penalties of a jump
    between a pixel and its right, lower and lower right neighbour, and along the other diagonal;
    int16, at most 1700. A path costs a matching cost and a jump at most, so that the sum of eight
    stays below INFEASIBLE.
    """
    # Each half has its own sum, so that two threads can work and order does not matter.
    totals = np.zeros((2, len(costs)), np.int16)
    jumps = (large_x, large_y, large_d, large_u)
    halves = [(costs, bands, *jumps, small, half == 0, totals[half]) for half in range(2)]
    run_calls(_sweep_half, halves)
    totals[0] += totals[1]
    return totals[0]


def select_planes(totals, bands, h, w):
    """Select the best plane [h, w] of every pixel, with fraction, and its margin over another one.

    Margins [h, w] are the difference to the best of the `totals` more than two planes away, per
    path and so in units of a matching cost. In a band without such a plane they are about
    INFEASIBLE / AGGREGATION_PATHS.
    """
    index = np.empty((h, w), np.float32)
    margin = np.empty((h, w), np.float32)
    share(_select_planes, h, totals, bands, index, margin)
    return index, margin


@njit(nogil=True, fastmath={"contract"})
def _select_planes(begin, end, totals, bands, index, margin):
    w = index.shape[1]
    for y in range(begin, end):
        for x in range(w):
            row, column = y // TILE_ROWS, x // TILE_COLUMNS
            first = _get_first_cost(bands, y, x, w)
            planes = bands.high[row, column] - bands.low[row, column]
            total = totals[first : first + planes]
            best = 0
            for k in range(planes):
                if total[k] < total[best]:
                    best = k
            # Neighbours of the best plane are the same surface, and no rivals.
            second = INFEASIBLE
            for k in range(planes):
                if abs(k - best) > 2:
                    second = min(second, total[k])
            margin[y, x] = np.float32(second - total[best]) / np.float32(AGGREGATION_PATHS)
            at = np.float32(bands.low[row, column] + best)
            if 0 < best < planes - 1:
                # Two lines of opposite gradient: less biased towards whole planes than a parabola.
                before = total[best - 1] - total[best]
                after = total[best + 1] - total[best]
                steeper = max(before, after)
                if steeper > 0:
                    at += np.float32(0.5) * np.float32(before - after) / np.float32(steeper)
            index[y, x] = at


def reproject(inverse, other, b_from_a, a_from_b):
    """Project every pixel of view a to view b and back, by inverse depths.

    inverse [h, w], other [H, W]: inverse depths of a and b. b_from_a, a_from_b [3, 4]: the
    transforms. Returns the distance between each pixel and where it comes back to, in pixels, or -1
    if it falls outside b or behind a camera; and its z-depth in b relative to b's own, 1 where the
    distance is -1. Both are [h, w].
    """
    error = np.empty(inverse.shape, np.float32)
    ratio = np.empty(inverse.shape, np.float32)
    share(_reproject, len(inverse), inverse, other, b_from_a, a_from_b, error, ratio)
    return error, ratio


def reproject_pixels(rows, columns, inverse, other, b_from_a, a_from_b):
    """Project some pixels as `reproject` does, at `rows` and `columns` [n] int64 of `inverse`.

    Returns distances and ratios [n].
    """
    error = np.empty(len(rows), np.float32)
    ratio = np.empty(len(rows), np.float32)
    # Those of `np.nonzero` are strided, for which a second kernel would be compiled.
    rows, columns = np.ascontiguousarray(rows), np.ascontiguousarray(columns)
    arguments = (rows, columns, inverse, other, b_from_a, a_from_b, error, ratio)
    share(_reproject_pixels, len(rows), *arguments)
    return error, ratio


@njit(nogil=True, fastmath={"contract"})
def _reproject(begin, end, inverse, other, b_from_a, a_from_b, error, ratio):
    for y in range(begin, end):
        for x in range(inverse.shape[1]):
            moved = _reproject_pixel(x, y, inverse[y, x], other, b_from_a, a_from_b)
            error[y, x], ratio[y, x] = moved


@njit(nogil=True, fastmath={"contract"})
def _reproject_pixels(begin, end, rows, columns, inverse, other, b_from_a, a_from_b, error, ratio):
    for k in range(begin, end):
        x, y = columns[k], rows[k]
        moved = _reproject_pixel(x, y, inverse[y, x], other, b_from_a, a_from_b)
        error[k], ratio[k] = moved


@njit(nogil=True, fastmath={"contract"})
def _reproject_pixel(x, y, own, other, b_from_a, a_from_b):
    """Return distance and ratio of one pixel of inverse depth `own`, as `reproject` does."""
    H, W = other.shape
    outside = np.float32(-1), np.float32(1)
    px = np.float32(x + 0.5)
    py = np.float32(y + 0.5)
    # Into b: the homogeneous pixel and, as its third entry, the ratio of z-depths.
    q2 = b_from_a[2, 0] * px + b_from_a[2, 1] * py + b_from_a[2, 2] + b_from_a[2, 3] * own
    if q2 <= np.float32(1e-3):
        return outside
    sx = b_from_a[0, 0] * px + b_from_a[0, 1] * py + b_from_a[0, 2] + b_from_a[0, 3] * own
    sy = b_from_a[1, 0] * px + b_from_a[1, 1] * py + b_from_a[1, 2] + b_from_a[1, 3] * own
    sx /= q2
    sy /= q2
    if not (sx >= 0 and sx < W and sy >= 0 and sy < H):
        return outside
    # The four pixels around may lie on two surfaces; the one that agrees best counts.
    best = np.float32(1e9)
    expected = own / q2
    value = other[int(sy), int(sx)]
    x0, y0 = int(np.floor(sx - 0.5)), int(np.floor(sy - 0.5))
    for k in range(4):
        xx = min(max(x0 + k % 2, 0), W - 1)
        yy = min(max(y0 + k // 2, 0), H - 1)
        if abs(other[yy, xx] - expected) < best:
            best = abs(other[yy, xx] - expected)
            value = other[yy, xx]
    # And back, with the inverse depth that b has there.
    r2 = a_from_b[2, 0] * sx + a_from_b[2, 1] * sy + a_from_b[2, 2] + a_from_b[2, 3] * value
    if r2 <= np.float32(1e-3):
        return outside
    rx = a_from_b[0, 0] * sx + a_from_b[0, 1] * sy + a_from_b[0, 2] + a_from_b[0, 3] * value
    ry = a_from_b[1, 0] * sx + a_from_b[1, 1] * sy + a_from_b[1, 2] + a_from_b[1, 3] * value
    rx = rx / r2 - px
    ry = ry / r2 - py
    return np.sqrt(rx * rx + ry * ry), value / max(expected, np.float32(1e-12))


def fill_background(values, known):
    """Return `values` [h, w] with unknown pixels filled from known ones in eight directions.

    Each takes the second lowest of the nearest known values, which are planes or inverse depths.
    Low ones are far away, and the lowest may be that of the one ray that misses an object in
    between. With fewer than two known, the pixel keeps its value.
    """
    filled = values.copy()
    share(_fill_background, len(values), values, known, filled)
    return filled


@njit(nogil=True)
def _fill_background(begin, end, values, known, filled):
    h, w = values.shape
    for y in range(begin, end):
        for x in range(w):
            if known[y, x]:
                continue
            lowest = np.float32(np.inf)
            second = np.float32(np.inf)
            # The eight neighbours of a 3 x 3 block are the directions.
            for direction in range(9):
                dy, dx = direction // 3 - 1, direction % 3 - 1
                if dy == 0 and dx == 0:
                    continue
                yy, xx = y + dy, x + dx
                while 0 <= yy < h and 0 <= xx < w and not known[yy, xx]:
                    yy += dy
                    xx += dx
                if 0 <= yy < h and 0 <= xx < w:
                    value = values[yy, xx]
                    if value < lowest:
                        lowest, second = value, lowest
                    elif value < second:
                        second = value
            if second < np.inf:
                filled[y, x] = second
