"""Compositing of splats tile by tile, front to back, and its gradients, back to front.

Splats are listed in the 16 × 16 tiles that they touch (`tiles.py`). Two lists are merged by
depth: the frozen `context`, and `new`, which gets gradients. Names of the former begin with `c_`,
those of the latter with `n_`; `c` and `n` are places in their lists. Depths are z-depths, and
`position` counts the splats of both lists from the front of a tile.

Kernels work on tiles[begin:end], the numbers of tiles row by row. Of one tile they keep `state`
[row, value, column], whose values the functions of `simd.py` name, and `row_limit` [row]: a splat
behind the limit of a row, by its position in the merged list, is skipped there. Front to back
it only tells full rows, -1, from others; back to front it is the last contribution of a row. Those
functions that go front to back return how many rows a splat filled, which are open no longer.

Each entry of `new` has a slot, in which its sums over a tile are written. The slots of a splat are
summed afterwards (`tiles.sum_entries`), so that tiles can be worked on in any order.
"""

from typing import NamedTuple

import numpy as np

from gscompleter.numerics.kernels import project, simd
from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.project import DEPTH
from gscompleter.numerics.kernels.simd import TILE

WANT_ALL, WANT_COLOR = range(2)
"""Gradients to compute: all columns, or only the three colours."""


class Layer(NamedTuple):
    """Splats, and for each tile the list of those that touch it, front to back."""

    splats: np.ndarray
    """[n, 9] float32, columns X to BLUE."""
    opacities: np.ndarray
    """[n] float32."""
    boxes: np.ndarray
    """Pixels that a splat may touch, int16 or int32 [n, 4]: x from, to; y from, to (excluded)."""
    tile_start: np.ndarray
    """Start of the list of each tile [tiles + 1] int64."""
    entries: np.ndarray
    """Index of the splat [entries] int32."""


class RasterFrame(NamedTuple):
    """A rendered image, and the state that the backward pass needs."""

    image: np.ndarray
    """Colours over black [h, w, 3] float32."""
    depth: np.ndarray
    """z-depth [h, w] float32, 0 for empty pixels."""
    alpha: np.ndarray
    """1 - transmittance [h, w] float32."""
    transmittance: np.ndarray
    """Transmittance behind the last contribution [h, w] float32."""
    last: np.ndarray
    """Position of the last contribution in the merged list of its tile, or -1 [h, w] int32."""
    used: np.ndarray
    """Entries of both lists that were composited until the tile was full [tiles, 2] int32."""
    full: np.ndarray
    """True for tiles without any transmittance left [tiles] bool."""


@njit()
def _get_depth(splats, entries, place, begin, end, beyond):
    """Return the z-depth of an entry, or `beyond` for places outside begin..end (excluded)."""
    if place < begin or place >= end:
        return beyond
    return splats[entries[place], DEPTH]


@njit(nogil=True)
def merge_lists(begin, end, context, new, used, full, tile_start, entries, depth_limits):
    """Merge the lists of the tiles begin..end of two layers, as far as they were composited.

    `used` and `full` are those of their frame. `entries` receives the lists, each from its
    tile_start on; splats of `new` are numbered after those of the context. depth_limits [tiles]
    receives the z-depth behind which a tile shows nothing.
    """
    c_splats, _, _, c_start, c_entries = context
    n_splats, _, _, n_start, n_entries = new
    infinity = np.float32(np.inf)
    for tile in range(begin, end):
        c = c_start[tile]
        n = n_start[tile]
        c_end = c + used[tile, 0]
        n_end = n + used[tile, 1]
        place = tile_start[tile]
        depth = infinity
        c_depth = _get_depth(c_splats, c_entries, c, c, c_end, infinity)
        n_depth = _get_depth(n_splats, n_entries, n, n, n_end, infinity)
        while c < c_end and n < n_end:
            if c_depth <= n_depth:
                depth = c_depth
                entries[place] = c_entries[c]
                c += 1
                c_depth = _get_depth(c_splats, c_entries, c, c, c_end, infinity)
            else:
                depth = n_depth
                entries[place] = len(c_splats) + n_entries[n]
                n += 1
                n_depth = _get_depth(n_splats, n_entries, n, n, n_end, infinity)
            place += 1
        # At most one of the lists has entries left.
        for rest in range(c, c_end):
            entries[place + rest - c] = c_entries[rest]
        for rest in range(n, n_end):
            entries[place + rest - n] = len(c_splats) + n_entries[rest]
        # Depth of the last entry: of a full tile, no splat behind it is shown.
        if c < c_end:
            depth = c_splats[c_entries[c_end - 1], DEPTH]
        if n < n_end:
            depth = n_splats[n_entries[n_end - 1], DEPTH]
        depth_limits[tile] = depth if full[tile] else infinity


@njit()
def _locate_tile(tile, height, width):
    """Return left and top pixel of a tile, and its rows and columns inside the image."""
    tiles_x = (width + TILE - 1) // TILE
    left = (tile % tiles_x) * TILE
    top = (tile // tiles_x) * TILE
    return left, top, min(TILE, height - top), min(TILE, width - left)


@njit()
def _open_pixels(state, columns):
    """Reset the pixels of a tile, of which the first `columns` of each row lie in the image.

    The others are full from the start, so that they keep no row open. Rows beyond the border are
    touched by no splat, as boxes end there.
    """
    state[:] = 0
    state[:, 0, :columns] = 1
    state[:, 0, columns:] = -1


@njit(fastmath={"contract"})
def _shift(splats, opacities, boxes, i, left, top):
    """Shift splat i to the tile at (left, top); return the rows that it touches there, and itself.

    The rows are first and stop (excluded). Of the splat, x and y are those of its centre from the
    first pixel centre of the tile; the other values are as `simd.composite_rows` takes them.
    """
    half = np.float32(0.5)
    return (
        max(np.int64(boxes[i, 2]) - top, 0),
        min(np.int64(boxes[i, 3]) - top, TILE),
        (
            splats[i, project.X] - np.float32(left) - half,
            splats[i, project.Y] - np.float32(top) - half,
            splats[i, project.U],
            splats[i, project.V],
            splats[i, project.W],
            opacities[i],
            splats[i, project.RED],
            splats[i, project.GREEN],
            splats[i, project.BLUE],
            splats[i, DEPTH],
        ),
    )


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def composite(begin, end, tiles, context, new, frame):
    """Composite tiles[begin:end] of two layers into `frame`, the context first at equal depth."""
    # Taking an array out of a tuple counts references, which must not happen in the loops.
    c_splats, c_opacities, c_boxes, c_start, c_entries = context
    n_splats, n_opacities, n_boxes, n_start, n_entries = new
    image, depths, alphas, transmittances, lasts, used, full = frame
    height, width = alphas.shape
    state = np.empty((TILE, 5, TILE), np.float32)
    last = np.empty((TILE, TILE), np.int32)
    row_limit = np.empty(TILE, np.int32)
    infinity = np.float32(np.inf)
    for index in range(begin, end):
        tile = tiles[index]
        left, top, rows, columns = _locate_tile(tile, height, width)
        _open_pixels(state, columns)
        last[:] = -1
        row_limit[:] = np.iinfo(np.int32).max
        open_rows = rows

        c_begin = c_start[tile]
        c_end = c_start[tile + 1]
        n_begin = n_start[tile]
        n_end = n_start[tile + 1]
        c = c_begin
        n = n_begin
        c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
        n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
        while open_rows > 0 and (c < c_end or n < n_end):
            position = np.int32(c - c_begin + n - n_begin)
            if c_depth <= n_depth:
                first, stop, splat = _shift(c_splats, c_opacities, c_boxes, c_entries[c], left, top)
                c += 1
                c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
            else:
                first, stop, splat = _shift(n_splats, n_opacities, n_boxes, n_entries[n], left, top)
                n += 1
                n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
            open_rows -= simd.composite_rows(first, stop, position, state, last, row_limit, splat)

        used[tile, 0] = c - c_begin
        used[tile, 1] = n - n_begin
        full[tile] = open_rows == 0
        # A negative transmittance marks a pixel that is full. The depth is the mean of those of the
        # splats by their weights, whose sum is alpha.
        for row in range(rows):
            for column in range(columns):
                transmittance = abs(state[row, 0, column])
                alpha = np.float32(1) - transmittance
                y = top + row
                x = left + column
                for channel in range(3):
                    image[y, x, channel] = state[row, 1 + channel, column]
                depths[y, x] = state[row, 4, column] / alpha if alpha > 0 else np.float32(0)
                alphas[y, x] = alpha
                transmittances[y, x] = transmittance
                lasts[y, x] = last[row, column]


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def backproject_residual(begin, end, tiles, context, new, photograph, slots, sums, written):
    """Composite tiles[begin:end] and backproject the residual to the entries of `new`.

    A splat's weights stay in the cache until the image of its tile is finished.
    photograph [h, w, 3] float32. slots [e] int32: slot of each entry of `new`.
    sums [slots, 4]: over the tile, weight times (photograph - image) per colour, and weight; set,
    as written [slots], for visited entries only.
    """
    c_splats, c_opacities, c_boxes, c_start, c_entries = context
    n_splats, n_opacities, n_boxes, n_start, n_entries = new
    height, width = photograph.shape[:2]
    state = np.empty((TILE, 4, TILE), np.float32)
    most = 1
    for index in range(begin, end):
        most = max(most, n_start[tiles[index] + 1] - n_start[tiles[index]] + 1)
    # Rows of weights, up to TILE for each splat of `new`, and for one of the context after them.
    # Those never written take no memory.
    kept = np.empty((most * TILE, TILE), np.float32)
    row_limit = np.empty(TILE, np.int32)
    totals = np.zeros(TILE, np.float32)
    infinity = np.float32(np.inf)
    for index in range(begin, end):
        tile = tiles[index]
        left, top, rows, columns = _locate_tile(tile, height, width)
        _open_pixels(state, columns)
        # Any number from 0 on marks an open row here.
        row_limit[:] = 0
        open_rows = rows

        c = c_start[tile]
        c_begin = c_start[tile]
        c_end = c_start[tile + 1]
        n = n_start[tile]
        n_begin = n_start[tile]
        n_end = n_start[tile + 1]
        c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
        n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
        # Row of `kept` at which the weights of the next splat begin.
        kept_row = np.int64(0)
        while open_rows > 0 and (c < c_end or n < n_end):
            if c_depth <= n_depth:
                first, stop, splat = _shift(c_splats, c_opacities, c_boxes, c_entries[c], left, top)
                c += 1
                c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
                # `kept_row` stays: its weights are not needed, and the next splat overwrites them.
                open_rows -= simd.weigh_rows(first, stop, kept_row, state, row_limit, kept, splat)
                continue
            first, stop, splat = _shift(n_splats, n_opacities, n_boxes, n_entries[n], left, top)
            n += 1
            n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
            open_rows -= simd.weigh_rows(first, stop, kept_row, state, row_limit, kept, splat)
            kept_row += max(stop - first, 0)

        # The image of the tile becomes its residual, in place.
        for row in range(rows):
            for channel in range(3):
                for column in range(columns):
                    wanted = photograph[top + row, left + column, channel]
                    state[row, 1 + channel, column] = wanted - state[row, 1 + channel, column]

        # The rows of weights lie in the order in which they were written.
        kept_row = 0
        for entry in range(n_begin, n):
            i = n_entries[entry]
            slot = slots[entry]
            first = max(np.int64(n_boxes[i, 2]) - top, 0)
            stop = min(np.int64(n_boxes[i, 3]) - top, TILE)
            simd.sum_weighted_rows(first, stop, kept_row, state, kept, totals)
            kept_row += max(stop - first, 0)
            written[slot] = True
            for column in range(4):
                sums[slot, column] = totals[column]


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def composite_backward(
    begin, end, tiles, context, new, frame, d_frame, slots, wanted, gradients, written
):
    """Traverse tiles[begin:end] back to front and sum the gradients of the entries of `new`.

    d_frame: gradients of image, depth and alpha. slots [e] int32: slot of each entry of `new`.
    gradients [slots, columns] has the columns of `project.py`, or three colours if `wanted` is
    WANT_COLOR; it is set, as written [slots], for visited entries only.
    """
    c_splats, c_opacities, c_boxes, c_start, c_entries = context
    n_splats, n_opacities, n_boxes, n_start, n_entries = new
    _, depths, alphas, transmittances, lasts, used, _ = frame
    d_image, d_depth, d_alpha = d_frame
    height, width = alphas.shape
    state = np.empty((TILE, 7, TILE), np.float32)
    last = np.empty((TILE, TILE), np.int32)
    row_limit = np.empty(TILE, np.int32)
    sums = np.zeros(TILE, np.float32)
    nothing = np.float32(-np.inf)
    for index in range(begin, end):
        tile = tiles[index]
        n_begin = n_start[tile]
        n = n_begin + used[tile, 1]
        if n == n_begin:
            continue
        left, top, rows, columns = _locate_tile(tile, height, width)
        state[:] = 0
        last[:] = -1
        row_limit[:] = -1
        # The depth is D = S / A, with S the weighted sum and A alpha: dL/dS = dL/dD / A, and alpha
        # gets -dL/dD D / A besides its own gradient.
        for row in range(rows):
            for column in range(columns):
                y = top + row
                x = left + column
                alpha = alphas[y, x]
                d_depth_sum = d_depth[y, x] / alpha if alpha > 0 else np.float32(0)
                state[row, 0, column] = transmittances[y, x]
                for channel in range(3):
                    state[row, 2 + channel, column] = d_image[y, x, channel]
                state[row, 5, column] = d_depth_sum
                state[row, 6, column] = d_alpha[y, x] - d_depth_sum * depths[y, x]
                last[row, column] = lasts[y, x]
                row_limit[row] = max(row_limit[row], last[row, column])

        c_begin = c_start[tile]
        c = c_begin + used[tile, 0]
        c_depth = _get_depth(c_splats, c_entries, c - 1, c_begin, c, nothing)
        n_depth = _get_depth(n_splats, n_entries, n - 1, n_begin, n, nothing)
        while n > n_begin:
            position = np.int32(c - c_begin + n - n_begin - 1)
            # The reverse of the forward order, in which the context comes first at equal depth. Its
            # splats get no gradients, but change the transmittance.
            if c_depth > n_depth:
                c -= 1
                first, stop, splat = _shift(c_splats, c_opacities, c_boxes, c_entries[c], left, top)
                c_depth = _get_depth(c_splats, c_entries, c - 1, c_begin, c, nothing)
                simd.pass_rows(first, stop, position, state, last, row_limit, sums, splat)
                continue
            n -= 1
            first, stop, splat = _shift(n_splats, n_opacities, n_boxes, n_entries[n], left, top)
            n_depth = _get_depth(n_splats, n_entries, n - 1, n_begin, n, nothing)
            slot = slots[n]
            written[slot] = True
            rows_of_splat = first, stop, position, state, last, row_limit, sums, splat
            if wanted == WANT_COLOR:
                simd.revert_rows_for_color(*rows_of_splat)
                for channel in range(3):
                    gradients[slot, channel] = sums[channel]
                continue
            simd.revert_rows(*rows_of_splat)
            # Moments of the gradient over the pixels, in x and y relative to the splat, become
            # moments in s = u x + v y and t = w y, in which the splat is round.
            # These are its third to fifth values.
            u = splat[2]
            v = splat[3]
            w = splat[4]
            sum_x = sums[1]
            sum_y = sums[2]
            sum_xx = sums[3]
            sum_xy = sums[4]
            sum_yy = sums[5]
            sum_sx = u * sum_xx + v * sum_xy
            sum_sy = u * sum_xy + v * sum_yy
            gradients[slot, project.SUM] = sums[0]
            gradients[slot, project.SUM_S] = u * sum_x + v * sum_y
            gradients[slot, project.SUM_T] = w * sum_y
            gradients[slot, project.SUM_SS] = u * sum_sx + v * sum_sy
            gradients[slot, project.SUM_ST] = w * sum_sy
            gradients[slot, project.SUM_TT] = w * w * sum_yy
            for channel in range(4):
                gradients[slot, project.SUM_DEPTH + channel] = sums[6 + channel]


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def backpropagate_images(
    begin, end, tiles, context, new, frame, d_images, slots, gradients, written
):
    """Traverse tiles[begin:end] back to front, as `composite_backward`, for opacities alone.

    The state is in several arrays, since some values are those of a pixel, and others those of a
    pixel in one image; they are as `simd.revert_images` takes them.
    d_images [count, h, w, 3]: gradients of the image of as many functions. gradients [slots, count]
    receives the sum of alpha dL/dalpha of each function, in one walk for all of them.
    """
    c_splats, c_opacities, c_boxes, c_start, c_entries = context
    n_splats, n_opacities, n_boxes, n_start, n_entries = new
    _, _, alphas, transmittances, lasts, used, _ = frame
    height, width = alphas.shape
    count = d_images.shape[0]
    passing = np.empty((TILE, TILE), np.float32)
    behinds = np.empty((TILE * count, TILE), np.float32)
    images = np.empty((TILE * count, 3, TILE), np.float32)
    last = np.empty((TILE, TILE), np.int32)
    row_limit = np.empty(TILE, np.int32)
    sums = np.empty((count, TILE), np.float32)
    nothing = np.float32(-np.inf)
    for index in range(begin, end):
        tile = tiles[index]
        n_begin = n_start[tile]
        n = n_begin + used[tile, 1]
        if n == n_begin:
            continue
        left, top, rows, columns = _locate_tile(tile, height, width)
        passing[:] = 0
        behinds[:] = 0
        images[:] = 0
        last[:] = -1
        row_limit[:] = -1
        for row in range(rows):
            for column in range(columns):
                y = top + row
                x = left + column
                passing[row, column] = transmittances[y, x]
                last[row, column] = lasts[y, x]
                row_limit[row] = max(row_limit[row], last[row, column])
                for image in range(count):
                    for channel in range(3):
                        place = row * count + image
                        images[place, channel, column] = d_images[image, y, x, channel]

        c_begin = c_start[tile]
        c = c_begin + used[tile, 0]
        c_depth = _get_depth(c_splats, c_entries, c - 1, c_begin, c, nothing)
        n_depth = _get_depth(n_splats, n_entries, n - 1, n_begin, n, nothing)
        while n > n_begin:
            position = np.int32(c - c_begin + n - n_begin - 1)
            if c_depth > n_depth:
                c -= 1
                first, stop, splat = _shift(c_splats, c_opacities, c_boxes, c_entries[c], left, top)
                c_depth = _get_depth(c_splats, c_entries, c - 1, c_begin, c, nothing)
                of_splat = first, stop, position, count
                simd.pass_images(*of_splat, passing, behinds, images, last, row_limit, sums, splat)
                continue
            n -= 1
            first, stop, splat = _shift(n_splats, n_opacities, n_boxes, n_entries[n], left, top)
            n_depth = _get_depth(n_splats, n_entries, n - 1, n_begin, n, nothing)
            of_splat = first, stop, position, count
            simd.revert_images(*of_splat, passing, behinds, images, last, row_limit, sums, splat)
            slot = slots[n]
            written[slot] = True
            for image in range(count):
                gradients[slot, image] = sums[image, 0]
