"""Colours that lines carry from the known part of an image into its holes."""

import numpy as np
from numba import njit

from gscompleter.kernels.parallel import share

NUM_SAMPLES = 3
"""Pixels behind the border whose mean a line carries; the outermost one is the least certain."""
LENGTH_FLOOR = np.float32(0.1)
"""Added to squared lengths, so that no weight is infinite."""


def trace_lines(image, known, directions, limits):
    """Trace the line through each pixel both ways, to the known pixels where it ends.

    Args:
        image: float32 [h, w, 3].
        known: bool [h, w].
        directions: float32 [h, w, 2], unit vectors (x, y) along the lines, of either sign.
        limits: float32 [h, w], length in pixels after which a way is given up; 0 for none.

    Returns:
        The mean colours at both ends [h, w, 3], weighted by the inverse squared lengths, and the
        length of the shorter way [h, w] in pixels, infinite if neither ends.
    """
    colours, lengths = np.zeros_like(image), np.full(known.shape, np.inf, np.float32)
    share(_trace_rows, len(known), image, known, directions, limits, colours, lengths)
    return colours, lengths


@njit(cache=True, nogil=True, fastmath={"contract"})
def _trace_rows(begin, end, image, known, directions, limits, colours, lengths):
    ends = np.empty(3, np.float32)
    for y in range(begin, end):
        for x in range(known.shape[1]):
            total = np.float32(0)
            for sign in (-1, 1):
                limit = limits[y, x]
                length = _trace_way(image, known, directions, y, x, sign, limit, ends)
                if length < limit:
                    weight = np.float32(1) / (length * length + LENGTH_FLOOR)
                    total += weight
                    colours[y, x] += weight * ends
                    lengths[y, x] = min(lengths[y, x], length)
            if total > 0:
                colours[y, x] /= total


@njit(cache=True, fastmath={"contract"})
def _trace_way(image, known, directions, row, column, sign, limit, mean):
    """Write the mean colour where a way ends, and return its length; `limit` if it has no end."""
    h, w = known.shape
    dx, dy = sign * directions[row, column, 0], sign * directions[row, column, 1]
    x, y = np.float32(column) + np.float32(0.5), np.float32(row) + np.float32(0.5)
    length, count = np.float32(0), 0
    mean[:] = 0
    while length < limit and count < NUM_SAMPLES:
        if known[row, column]:
            mean += image[row, column]
            count += 1
        elif count > 0:
            break
        else:
            length += np.float32(1)
        ahead_x, ahead_y = directions[row, column, 0], directions[row, column, 1]
        if ahead_x * dx + ahead_y * dy < 0:
            ahead_x, ahead_y = -ahead_x, -ahead_y
        dx, dy = ahead_x, ahead_y
        x, y = x + dx, y + dy
        row, column = int(np.floor(y)), int(np.floor(x))
        if row < 0 or row >= h or column < 0 or column >= w:
            break
    if count == 0:
        return limit
    mean /= np.float32(count)
    return length
