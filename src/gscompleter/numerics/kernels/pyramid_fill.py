"""Interpolation of single pixels from a pyramid of neighbourhood means."""

from typing import NamedTuple

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.parallel import share

MIN_LEVEL_WEIGHT = np.float32(1e-6)
"""Smallest weight of a neighbourhood; below it the next wider one is used."""


class Pyramid(NamedTuple):
    """Weighted sums over neighbourhoods that widen from level to level."""

    sums: np.ndarray
    """float32 [n, c]: the pixels of all levels, row by row; the last channel is the weight."""
    starts: np.ndarray
    """Index in `sums` of the first pixel of each level [levels]."""
    sizes: np.ndarray
    """Height and width of each level [levels, 2]; the first is the size of the image."""
    global_mean: np.ndarray
    """Mean of the image [c - 1], for pixels without weight on any level."""


def build_pyramid(levels):
    """Build the pyramid of `levels`, float32 [h, w, c] each."""
    sizes = np.array([level.shape[:2] for level in levels])
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]])
    sums = np.concatenate([level.reshape(-1, level.shape[2]) for level in levels])
    total = levels[0].sum(axis=(0, 1))
    return Pyramid(sums, starts, sizes, total[:-1] / total[-1])


def compute_means(pyramid, pixels, level):
    """Compute means [p, c - 1] around `pixels` (y, x) [p, 2], at fractional levels `level` [p]."""
    found = np.empty((len(pixels), len(pyramid.global_mean)), np.float32)
    share(_compute_means, len(pixels), pyramid, pixels, level, found)
    return found


@njit(nogil=True, fastmath={"contract"})
def _compute_means(begin, end, pyramid, pixels, level, result):
    count = len(pyramid.global_mean)
    wider = np.empty(count, np.float32)
    sums = np.empty(count + 1, np.float32)
    for p in range(begin, end):
        below = int(level[p])
        above = np.float32(level[p] - below)
        _compute_known_mean(pyramid, pixels[p, 0], pixels[p, 1], below, sums, result[p])
        if above > 0:
            _compute_known_mean(pyramid, pixels[p, 0], pixels[p, 1], below + 1, sums, wider)
            for c in range(count):
                result[p, c] = (np.float32(1) - above) * result[p, c] + above * wider[c]


@njit(fastmath={"contract"})
def _compute_known_mean(pyramid, y, x, number, sums, mean):
    count = len(pyramid.global_mean)
    for level in range(number, len(pyramid.starts)):
        _sample(pyramid, y, x, level, sums)
        if sums[count] > MIN_LEVEL_WEIGHT:
            for c in range(count):
                mean[c] = sums[c] / sums[count]
            return
    for c in range(count):
        mean[c] = pyramid.global_mean[c]


@njit(fastmath={"contract"})
def _sample(pyramid, y, x, level, sums):
    """Write the sums of a level at a pixel of the image, interpolated bilinearly."""
    start, h, w = pyramid.starts[level], pyramid.sizes[level, 0], pyramid.sizes[level, 1]
    top, down = _locate_sample(y, h, pyramid.sizes[0, 0])
    left, along = _locate_sample(x, w, pyramid.sizes[0, 1])
    bottom, right = min(top + 1, h - 1), min(left + 1, w - 1)
    for c in range(len(sums)):
        a = pyramid.sums[start + top * w + left, c]
        b = pyramid.sums[start + top * w + right, c]
        upper = a + along * (b - a)
        a = pyramid.sums[start + bottom * w + left, c]
        b = pyramid.sums[start + bottom * w + right, c]
        sums[c] = upper + down * (a + along * (b - a) - upper)


@njit(inline="always")
def _locate_sample(pixel, count, total):
    exact = min(max((pixel + 0.5) * count / total - 0.5, 0.0), count - 1.0)
    first = int(exact)
    return first, np.float32(exact - first)
