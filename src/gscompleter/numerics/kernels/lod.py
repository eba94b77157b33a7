"""Runs of adjacent Gaussians, each replaced by a single one."""

import math

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.project import normalize_quat, rotate_by_quat
from gscompleter.numerics.kernels.splat_rows import copy_row

RUN_BLOCK = 4096
"""Consecutive Gaussians that are cut into runs independently of the others."""
MAX_RUN_OPACITY = np.float32(0.9999)
"""Largest opacity, which keeps the logarithm of the transmittance finite."""
MAX_THICKNESS = np.float32(4.6)
"""Optical thickness (at opacity 0.99) beyond which a Gaussian hardly gets wider."""
MIN_WEIGHT_SUM = np.float32(1e-30)


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def mark_run_starts(begin, end, means, scales, generated, centers, focals, reach, largest, begins):
    """Write to `begins` [n] which Gaussians of the blocks begin..end start a run.

    It continues while the next Gaussian has the provenance of the first, lies within `reach` pixels
    of it, and is no wider than `largest` pixels, for the smallest pixel of all cameras.
    """
    for block in range(begin, end):
        pixel = np.float32(-1)
        x = np.float32(0)
        y = np.float32(0)
        z = np.float32(0)
        origin = generated[block * RUN_BLOCK]
        for i in range(block * RUN_BLOCK, min((block + 1) * RUN_BLOCK, len(means))):
            dx = means[i, 0] - x
            dy = means[i, 1] - y
            dz = means[i, 2] - z
            size = max(scales[i, 0], scales[i, 1], scales[i, 2])
            apart = dx * dx + dy * dy + dz * dz
            near = size <= largest * pixel and apart <= (reach * pixel) ** 2
            begins[i] = not (near and generated[i] == origin)
            if begins[i]:
                x = means[i, 0]
                y = means[i, 1]
                z = means[i, 2]
                origin = generated[i]
                pixel = _compute_pixel_size(x, y, z, centers, focals)
                # Nothing joins a Gaussian that is too wide itself: no distance is below a negative.
                if size > largest * pixel:
                    pixel = np.float32(-1)


@njit(fastmath={"contract"}, error_model="numpy")
def _compute_pixel_size(x, y, z, centers, focals):
    """Compute the smallest pixel of all cameras at a point, in scene units."""
    smallest = np.float32(np.inf)
    for k in range(len(centers)):
        dx = x - centers[k, 0]
        dy = y - centers[k, 1]
        dz = z - centers[k, 2]
        smallest = min(smallest, (dx * dx + dy * dy + dz * dz) / (focals[k] * focals[k]))
    return math.sqrt(smallest)


@njit(fastmath={"contract"}, error_model="numpy")
def _compute_cross_section(scales, i):
    a = scales[i, 0]
    b = scales[i, 1]
    c = scales[i, 2]
    return max(a * b, b * c, c * a)


@njit(fastmath={"contract"})
def _compute_thickness(opacity):
    """Compute the optical thickness t of an opacity: exp(-t) is the transmittance."""
    return -math.log(np.float32(1) - min(opacity, MAX_RUN_OPACITY))


@njit()
def _compute_fullness(thickness):
    """Compute the area of 1 - exp(-thickness g) relative to a Gaussian g of the same peak."""
    return np.float32(1) + np.float32(0.25) * min(thickness, MAX_THICKNESS)


@njit(fastmath={"contract"}, error_model="numpy")
def _compute_shares(first, last, scales, opacities, shares):
    """Write shares of first..last in thickness times cross-section; return largest and total."""
    total = np.float32(0)
    most = first
    for i in range(first, last):
        shares[i] = _compute_thickness(opacities[i]) * _compute_cross_section(scales, i)
        total += shares[i]
        if shares[i] > shares[most]:
            most = i
    for i in range(first, last):
        alike = np.float32(1) / np.float32(last - first)
        shares[i] = shares[i] / total if total > np.float32(0) else alike
    return most, total


@njit(fastmath={"contract"})
def _compute_run_mean(first, last, shares, values, mean):
    for column in range(len(mean)):
        begun = values[first, column]
        away = np.float32(0)
        for i in range(first, last):
            away += shares[i] * (values[i, column] - begun)
        mean[column] = begun + away


@njit(fastmath={"contract"}, error_model="numpy")
def _compute_variance(first, last, shares, means, quats, scales, mean, axis):
    """Compute the variance of a run along a unit axis: that of the means, plus that of each."""
    ax, ay, az = axis
    variance = np.float32(0)
    for i in range(first, last):
        dx = means[i, 0] - mean[0]
        dy = means[i, 1] - mean[1]
        dz = means[i, 2] - mean[2]
        squares = (ax * dx + ay * dy + az * dz) ** 2
        own = rotate_by_quat(normalize_quat(quats, i)[0])
        for k in range(3):
            along = (ax * own[k] + ay * own[3 + k] + az * own[6 + k]) * scales[i, k]
            squares += along * along
        variance += shares[i] * squares
    return variance


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def merge_run_range(begin, end, start, gaussians, shares, merged):
    """Merge each of the runs begin..end into one Gaussian.

    It has their joint transmittance, mean position and colour, and variances along the axes of the
    largest. Thicker ones are made wider, since 1 - exp(-t g) falls off more slowly than g.
    """
    means, quats, scales, opacities, sh = gaussians
    to_means, to_quats, to_scales, to_opacities, to_sh = merged
    for run in range(begin, end):
        first = start[run]
        last = start[run + 1]
        most, total = _compute_shares(first, last, scales, opacities, shares)
        _compute_run_mean(first, last, shares, means, to_means[run])
        _compute_run_mean(first, last, shares, sh, to_sh[run])
        copy_row(quats, most, to_quats, run)
        if last - first == 1:
            copy_row(scales, first, to_scales, run)
            to_opacities[run] = opacities[first]
            continue
        axes = rotate_by_quat(normalize_quat(quats, most)[0])
        for k in range(3):
            axis = axes[k], axes[3 + k], axes[6 + k]
            seen = (means, quats, scales, to_means[run], axis)
            to_scales[run, k] = math.sqrt(_compute_variance(first, last, shares, *seen))
        thickness = total / max(_compute_cross_section(to_scales, run), MIN_WEIGHT_SUM)
        before = np.float32(0)
        for i in range(first, last):
            before += shares[i] * _compute_thickness(opacities[i])
        wider = math.sqrt(_compute_fullness(thickness) / _compute_fullness(before))
        for k in range(3):
            to_scales[run, k] *= wider
        to_opacities[run] = min(-math.expm1(-thickness), MAX_RUN_OPACITY)
