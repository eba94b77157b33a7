"""Runs of Gaussians that lie so close to each other that one may stand for all of a run.

Every kernel works on a range (begin, end) of its elements and writes to its own part of the
outputs.
"""

import math

import numpy as np
from numba import njit

BLOCK = 4096
"""Gaussians, one after the other, that are cut into runs by themselves."""
OPAQUE = np.float32(0.9999)
"""Opacity beyond which nothing gets more opaque; the logarithm of what is let through is finite."""
MOST_FULL = np.float32(4.6)
"""Thickness beyond which something hardly gets wider: its opacity is 0.99."""
NONE = np.float32(1e-30)
"""What is divided by instead of 0."""


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def begin_runs(begin, end, means, scales, generated, centers, focals, reach, largest, begins):
    """Whether each Gaussian of the blocks begin..end begins a run.

    A run goes on as long as what follows is of one provenance with its first Gaussian and lies
    within `reach` pixels of it, and no standard deviation exceeds `largest` pixels: of the camera
    in which a pixel covers least there.

    means [n, 3], scales [n, 3] float32, generated [n] uint8, centers [k, 3], focals [k]
        float32. begins [n] bool is written.
    """
    for block in range(begin, end):
        pixel, x, y, z = np.float32(-1), np.float32(0), np.float32(0), np.float32(0)
        origin = generated[block * BLOCK]
        for i in range(block * BLOCK, min((block + 1) * BLOCK, len(means))):
            dx, dy, dz = means[i, 0] - x, means[i, 1] - y, means[i, 2] - z
            size = max(scales[i, 0], scales[i, 1], scales[i, 2])
            apart = dx * dx + dy * dy + dz * dz
            near = size <= largest * pixel and apart <= (reach * pixel) ** 2
            begins[i] = not (near and generated[i] == origin)
            if begins[i]:
                x, y, z, origin = means[i, 0], means[i, 1], means[i, 2], generated[i]
                pixel = _pixel(x, y, z, centers, focals)
                if size > largest * pixel:
                    pixel = np.float32(-1)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _pixel(x, y, z, centers, focals):
    """What the smallest pixel of all cameras covers at a point, in scene units."""
    smallest = np.float32(np.inf)
    for k in range(len(centers)):
        dx, dy, dz = x - centers[k, 0], y - centers[k, 1], z - centers[k, 2]
        smallest = min(smallest, (dx * dx + dy * dy + dz * dz) / (focals[k] * focals[k]))
    return math.sqrt(smallest)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _cross_section(scales, i):
    """Of Gaussian i, from its broad side."""
    a, b, c = scales[i, 0], scales[i, 1], scales[i, 2]
    return max(a * b, b * c, c * a)


@njit(cache=True, fastmath={"contract"})
def _thickness(opacity):
    """The t of which exp(-t) is let through."""
    return -math.log(np.float32(1) - min(opacity, OPAQUE))


@njit(cache=True)
def _fullness(thickness):
    """The area of 1 - exp(-thickness g), as a share of that of a Gaussian g of the same peak."""
    return np.float32(1) + np.float32(0.25) * min(thickness, MOST_FULL)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _rotation(quats, i):
    """The rotated axes of Gaussian i as columns [3][3]."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    inverse = np.float32(1) / math.sqrt(max(w * w + x * x + y * y + z * z, NONE))
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    one, two = np.float32(1), np.float32(2)
    return (
        (one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)),
        (two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)),
        (two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)),
    )


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _share_out(first, last, scales, opacities, shares):
    """How much each Gaussian of first..last is of them, by what it lets through and covers; which
    is most, and what all of them are together."""
    total, most = np.float32(0), first
    for i in range(first, last):
        shares[i] = _thickness(opacities[i]) * _cross_section(scales, i)
        total += shares[i]
        if shares[i] > shares[most]:
            most = i
    for i in range(first, last):
        alike = np.float32(1) / np.float32(last - first)
        shares[i] = shares[i] / total if total > np.float32(0) else alike
    return most, total


@njit(cache=True, fastmath={"contract"})
def _mean(first, last, shares, values, mean):
    """Write the mean of values[first:last] by shares; it is told from the first of them."""
    for column in range(len(mean)):
        begun = values[first, column]
        away = np.float32(0)
        for i in range(first, last):
            away += shares[i] * (values[i, column] - begun)
        mean[column] = begun + away


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _variance(first, last, shares, means, quats, scales, mean, axis):
    """Of Gaussians first..last together about `mean` along a unit `axis`."""
    ax, ay, az = axis
    variance = np.float32(0)
    for i in range(first, last):
        dx, dy, dz = means[i, 0] - mean[0], means[i, 1] - mean[1], means[i, 2] - mean[2]
        squares = (ax * dx + ay * dy + az * dz) ** 2
        own = _rotation(quats, i)
        for k in range(3):
            along = (ax * own[0][k] + ay * own[1][k] + az * own[2][k]) * scales[i, k]
            squares += along * along
        variance += shares[i] * squares
    return variance


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def stand_for(begin, end, start, given, shares, found):
    """One Gaussian for each of the runs begin..end, and the share of each Gaussian in its run.

    It lets through what all of them let through together, lies where they lie in the mean, has the
    mean of their colours, and their spread along the axes of the one that counts most. What is
    thicker is wider, too: 1 - exp(-t g) falls more slowly than g.

    start [m + 1] int64: where each run starts, and the end.
    given: GaussianArrays of n, with sh [n, 3 k].
    shares [n] float32, and found, the same as `given` of m, are written.
    """
    means, quats, scales, opacities, sh = given
    to_means, to_quats, to_scales, to_opacities, to_sh = found
    for run in range(begin, end):
        first, last = start[run], start[run + 1]
        most, total = _share_out(first, last, scales, opacities, shares)
        _mean(first, last, shares, means, to_means[run])
        _mean(first, last, shares, sh, to_sh[run])
        to_quats[run] = quats[most]
        if last - first == 1:
            to_scales[run], to_opacities[run] = scales[first], opacities[first]
            continue
        axes = _rotation(quats, most)
        for k in range(3):
            axis = axes[0][k], axes[1][k], axes[2][k]
            seen = (means, quats, scales, to_means[run], axis)
            to_scales[run, k] = math.sqrt(_variance(first, last, shares, *seen))
        thickness = total / max(_cross_section(to_scales, run), NONE)
        before = np.float32(0)
        for i in range(first, last):
            before += shares[i] * _thickness(opacities[i])
        to_scales[run] *= math.sqrt(_fullness(thickness) / _fullness(before))
        to_opacities[run] = min(-math.expm1(-thickness), OPAQUE)
