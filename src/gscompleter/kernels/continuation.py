"""Means over neighbourhoods of a pyramid, at pixels of the full image."""

from typing import NamedTuple

import numpy as np
from numba import njit

from gscompleter.kernels.sharing import share

LEAST_WEIGHT = np.float32(1e-6)
"""Of a neighbourhood; where it holds less, the next wider one stands in."""


class Pyramid(NamedTuple):
    """Weighted sums over wider and wider neighbourhoods, level after level."""

    sums: np.ndarray
    """float32 [n, c]: the pixels of all levels, row after row; the last channel is the weight."""
    starts: np.ndarray
    """Where each level begins in it [levels]."""
    sizes: np.ndarray
    """Height and width of each level [levels, 2]; the first is as large as the image."""
    everywhere: np.ndarray
    """float32 [c - 1]: the mean of all, where even the widest neighbourhood holds no weight."""


def pyramid_of(levels):
    """The pyramid of `levels`, float32 [h, w, c] each."""
    sizes = np.array([level.shape[:2] for level in levels])
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]])
    sums = np.concatenate([level.reshape(-1, level.shape[2]) for level in levels])
    total = levels[0].sum(axis=(0, 1))
    return Pyramid(sums, starts, sizes, total[:-1] / total[-1])


def means(pyramid, pixels, level):
    """What surrounds `pixels` (y, x) [p, 2], each in neighbourhoods of its own `level` [p].

    A level that is no whole number is a mixture of the two it lies between. Returns [p, c - 1].
    """
    found = np.empty((len(pixels), len(pyramid.everywhere)), np.float32)
    share(_means, len(pixels), pyramid, pixels, level, found)
    return found


@njit(cache=True, nogil=True, fastmath={"contract"})
def _means(begin, end, pyramid, pixels, level, found):
    """Fill in the pixels from `begin` to `end`."""
    count = len(pyramid.everywhere)
    wider, sums = np.empty(count, np.float32), np.empty(count + 1, np.float32)
    for p in range(begin, end):
        below = int(level[p])
        above = np.float32(level[p] - below)
        _mean(pyramid, pixels[p, 0], pixels[p, 1], below, sums, found[p])
        if above > 0:
            _mean(pyramid, pixels[p, 0], pixels[p, 1], below + 1, sums, wider)
            for c in range(count):
                found[p, c] = (np.float32(1) - above) * found[p, c] + above * wider[c]


@njit(cache=True, fastmath={"contract"})
def _mean(pyramid, y, x, number, sums, mean):
    """Write the mean around a pixel on level `number`, or on the first above it that has one."""
    count = len(pyramid.everywhere)
    for level in range(number, len(pyramid.starts)):
        _sample(pyramid, y, x, level, sums)
        if sums[count] > LEAST_WEIGHT:
            for c in range(count):
                mean[c] = sums[c] / sums[count]
            return
    for c in range(count):
        mean[c] = pyramid.everywhere[c]


@njit(cache=True, fastmath={"contract"})
def _sample(pyramid, y, x, level, sums):
    """Write the sums of a level at a pixel of the image, between four pixels of the level."""
    start, h, w = pyramid.starts[level], pyramid.sizes[level, 0], pyramid.sizes[level, 1]
    top, down = _between(y, h, pyramid.sizes[0, 0])
    left, along = _between(x, w, pyramid.sizes[0, 1])
    bottom, right = min(top + 1, h - 1), min(left + 1, w - 1)
    for c in range(len(sums)):
        a, b = pyramid.sums[start + top * w + left, c], pyramid.sums[start + top * w + right, c]
        upper = a + along * (b - a)
        a, b = (
            pyramid.sums[start + bottom * w + left, c],
            pyramid.sums[start + bottom * w + right, c],
        )
        sums[c] = upper + down * (a + along * (b - a) - upper)


@njit(cache=True, inline="always")
def _between(place, count, of):
    """The pixel of `count` before a pixel's centre of `of`, and how far beyond its own it lies."""
    exact = min(max((place + 0.5) * count / of - 0.5, 0.0), count - 1.0)
    first = int(exact)
    return first, np.float32(exact - first)
