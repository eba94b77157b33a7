"""Colours that lines carry from the known part of an image into its holes."""

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.parallel import share

NUM_CARRIED_PIXELS = 3
"""Pixels behind the border whose mean a line carries; the outermost one is the least certain."""
LENGTH_FLOOR = np.float32(0.1)
"""Added to squared lengths, so that no weight is infinite."""


def trace_lines(image, known, directions, limits):
    """Trace the line through each pixel both ways, to the first known pixels that it meets.

    A length counts the unknown pixels on the way, that of the beginning included.

    Args:
        image: float32 [h, w, 3].
        known: bool [h, w].
        directions: float32 [h, w, 2], unit vectors (x, y) along the lines, of either sign.
        limits: float32 [h, w], finite length in pixels after which a way is given up; where it is
            0, no line is traced.

    Returns:
        The mean colours at both ends [h, w, 3], weighted by the inverse squared lengths and 0
        without an end, and the length of the shorter way [h, w] in pixels, infinite without one.
    """
    colors = np.zeros_like(image)
    lengths = np.full(known.shape, np.inf, np.float32)
    share(_trace_rows, len(known), image, known, directions, limits, colors, lengths)
    return colors, lengths


@njit(nogil=True, fastmath={"contract"})
def _trace_rows(begin, end, image, known, directions, limits, colors, lengths):
    for y in range(begin, end):
        for x in range(known.shape[1]):
            total = np.float32(0)
            limit = limits[y, x]
            for sign in (np.float32(-1), np.float32(1)):
                length, r, g, b = _trace_way(image, known, directions, y, x, sign, limit)
                if length < limit:
                    weight = np.float32(1) / (length * length + LENGTH_FLOOR)
                    total += weight
                    colors[y, x, 0] += weight * r
                    colors[y, x, 1] += weight * g
                    colors[y, x, 2] += weight * b
                    lengths[y, x] = min(lengths[y, x], length)
            # Without an end the total is 0, and so are the colours.
            for c in range(3):
                colors[y, x, c] /= max(total, np.float32(1e-12))


@njit(fastmath={"contract"})
def _trace_way(image, known, directions, row, column, sign, limit):
    """Return the length of a way and the mean colour at its end; `limit` if it has no end."""
    h, w = known.shape
    dx, dy = sign * directions[row, column, 0], sign * directions[row, column, 1]
    x, y = np.float32(column) + np.float32(0.5), np.float32(row) + np.float32(0.5)
    r = g = b = length = count = np.float32(0)
    while length < limit and count < NUM_CARRIED_PIXELS:
        if known[row, column]:
            r += image[row, column, 0]
            g += image[row, column, 1]
            b += image[row, column, 2]
            count += np.float32(1)
        elif count > 0:
            break
        else:
            length += np.float32(1)
        x += dx
        y += dy
        if x < 0 or y < 0 or x >= w or y >= h:
            break
        row, column = int(y), int(x)
        ahead_x, ahead_y = directions[row, column, 0], directions[row, column, 1]
        turn = np.float32(1) if ahead_x * dx + ahead_y * dy >= 0 else np.float32(-1)
        dx, dy = turn * ahead_x, turn * ahead_y
    if count == 0:
        return limit, r, g, b
    return length, r / count, g / count, b / count
