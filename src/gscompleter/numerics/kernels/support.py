"""Trust in Gaussians, from how far photographs agree with their render, block by block.

The last arguments of a kernel are the arrays that it writes. Lengths are in scene units.
"""

import math
from typing import NamedTuple

import numpy as np

from gscompleter.numerics.kernels.cache import njit

SUPPORT_BLOCK = 256
"""Gaussians per block."""
MIN_ANGLE_WEIGHT = np.float32(1e-6)
"""Smallest angular weight: opposite photographs count if there are no others."""
SMALLEST_DIVISOR = np.float32(1e-20)
"""Takes the place of a sum or a squared length of 0, which would be divided by."""

# Abramowitz and Stegun 4.4.46: acos(x) = sqrt(1 - x) p(x) from 0 to 1, to 2e-8.
_A0, _A1, _A2, _A3 = map(np.float32, (1.5707963050, -0.2145988016, 0.0889789874, -0.0501743046))
_A4, _A5, _A6, _A7 = map(np.float32, (0.0308918810, -0.0170881256, 0.0066700901, -0.0012624911))
# Least squares polynomial of 2**x on [-1, 0]: relative error 2e-7.
_E0, _E1, _E2 = map(np.float32, (0.999999923, 0.693142171, 0.240171588))
_E3, _E4, _E5 = map(np.float32, (0.055278135, 0.00918687438, 0.000938116473))
_LOG2_E32 = np.float32(1.4426950408889634)
_PI = np.float32(math.pi)


class CameraPose(NamedTuple):
    """The position, viewing direction and focal lengths of a camera, float32."""

    center: np.ndarray
    """Camera centre in the world [3]."""
    forward: np.ndarray
    """Unit viewing direction [3]."""
    focal_product: np.float32
    """Product of fx and fy, in squared pixels."""


@njit(fastmath={"contract"})
def _acos(x):
    """Compute the arccosine as sqrt(1 - |x|) times a polynomial in |x|."""
    one = np.float32(1)
    away = min(abs(x), one)
    series = _A3 + away * (_A4 + away * (_A5 + away * (_A6 + away * _A7)))
    series = _A0 + away * (_A1 + away * (_A2 + away * series))
    angle = math.sqrt(one - away) * series
    return angle if x >= np.float32(0) else _PI - angle


@njit(fastmath={"contract"})
def _exp_negative(x):
    """Compute exp(-x) for x >= 0; beyond 80 it is practically 0."""
    power = max(-_LOG2_E32 * x, np.float32(-120))
    # 2^power by its whole part, which goes into the exponent of a float32, and a polynomial for the
    # rest, in (-1, 0].
    whole = np.int32(power)
    rest = power - np.float32(whole)
    series = _E0 + rest * (_E1 + rest * (_E2 + rest * (_E3 + rest * (_E4 + rest * _E5))))
    return series * np.int32((whole + 127) << 23).view(np.float32)


@njit(fastmath={"contract"}, error_model="numpy")
def _compute_pixel_area(means, i, place):
    """Compute the area of a pixel at the depth of Gaussian i, in squared scene units."""
    center = place.center
    forward = place.forward
    z = (means[i, 0] - center[0]) * forward[0]
    z += (means[i, 1] - center[1]) * forward[1]
    z += (means[i, 2] - center[2]) * forward[2]
    z = max(z, np.float32(0))
    return z * z / place.focal_product


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def measure_photo_agreement(begin, end, sums, means, place, areas, agreement):
    """Compute the visible area of the Gaussians begin..end in a photograph, and its agreement.

    sums [n, 3] float32: compositing weights, and their products with agreement, summed over pixels;
    the third column is not read. means [n, 3] float32: centres. place: `CameraPose` of the
    photograph. areas, agreement [n] float32: written.
    """
    for i in range(begin, end):
        areas[i] = sums[i, 0] * _compute_pixel_area(means, i, place)
        agreement[i] = sums[i, 1] / max(sums[i, 0], np.float32(1e-9))


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def _add_agreement(x, y, z, rays, center, per_turn, areas, agreement, totals):
    """Add the weighted agreement of the photograph at `center` to the sums of a block.

    x, y, z: centres of the Gaussians; rays: unit vectors to them from the camera that asks. Where a
    photograph looks along another ray, its weight falls with that angle times `per_turn`.
    """
    one = np.float32(1)
    ray_x, ray_y, ray_z = rays
    agreeing, weights, largest = totals
    center_x, center_y, center_z = center
    for j in range(len(areas)):
        dx = x[j] - center_x
        dy = y[j] - center_y
        dz = z[j] - center_z
        inverse = one / math.sqrt(max(dx * dx + dy * dy + dz * dz, SMALLEST_DIVISOR))
        angle = _acos((dx * ray_x[j] + dy * ray_y[j] + dz * ray_z[j]) * inverse)
        turned = angle * per_turn
        weight = areas[j] * (_exp_negative(turned * turned) + MIN_ANGLE_WEIGHT)
        agreeing[j] += weight * agreement[j]
        weights[j] += weight
        largest[j] = max(largest[j], areas[j])


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def accumulate_trust(
    begin, end, centers, areas, agreement, means, sums, place, max_turn, enough, values
):
    """Compute the trust of the Gaussians begin..end as seen from a camera; 1 if it sees nothing.

    centers [k, 3], areas [k, n], agreement [k, n] float32, see `PhotoObservations`.
    means [n, 3] float32: centres. sums [n] float32: compositing weights at the camera, summed over
    pixels. place: its `CameraPose`.
    max_turn: angle at which the weight of a photograph has fallen to 1/e, in radians.
    enough: share of the area seen by the camera that a photograph has to see for full trust.
    values [n] float32: trust in [0, 1], written.
    """
    one = np.float32(1)
    per_turn = one / max_turn
    known = np.empty((6, SUPPORT_BLOCK), np.float32)
    x, y, z, ray_x, ray_y, ray_z = known
    rays = ray_x, ray_y, ray_z
    sums_of_block = np.empty((3, SUPPORT_BLOCK), np.float32)
    agreeing, weights, largest = sums_of_block
    totals = agreeing, weights, largest
    for start in range(begin, end, SUPPORT_BLOCK):
        count = min(SUPPORT_BLOCK, end - start)
        sums_of_block[:] = 0
        for j in range(count):
            x[j], y[j], z[j] = means[start + j, 0], means[start + j, 1], means[start + j, 2]
            dx = x[j] - place.center[0]
            dy = y[j] - place.center[1]
            dz = z[j] - place.center[2]
            inverse = one / math.sqrt(max(dx * dx + dy * dy + dz * dz, SMALLEST_DIVISOR))
            ray_x[j], ray_y[j], ray_z[j] = dx * inverse, dy * inverse, dz * inverse
        for k in range(len(centers)):
            center = centers[k, 0], centers[k, 1], centers[k, 2]
            shown = areas[k, start : start + count], agreement[k, start : start + count]
            _add_agreement(x, y, z, rays, center, per_turn, *shown, totals)
        for j in range(count):
            i = start + j
            needed = max(sums[i] * _compute_pixel_area(means, i, place), SMALLEST_DIVISOR)
            share = min(largest[j] / (enough * needed), one)
            supported = share * agreeing[j] / max(weights[j], SMALLEST_DIVISOR)
            values[i] = supported if sums[i] > 0 else one
