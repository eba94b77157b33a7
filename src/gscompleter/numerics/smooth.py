"""Smooth continuation of colours into unknown pixels.

Tensors lie on the CPU, since OpenCV and SciPy compute; only `average_trusted` takes any device.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from torch import Tensor

from gscompleter.numerics.kernels.pyramid_fill import build_pyramid, compute_means
from gscompleter.types import Render

BLUR_SIGMA = 1.5
"""Standard deviation of the blur of each pyramid level, in its pixels."""
SIGMA_PER_DISTANCE = 0.7
"""Standard deviation of the averaging, relative to the distance to known pixels."""
MEMBRANE_SIDE = 96
"""Cells along the longer side of a membrane."""
FIDELITY = 8.0
"""Weight of the colour of a known cell, relative to its difference to one neighbour."""
MEAN_WEIGHT = 1e-3
"""Weight of the mean colour in every cell, on the same scale."""
MEANS_SIDE = 160
"""Longer side of the small image in which trusted colours are averaged, in pixels."""
FIRST_SIGMA = 5.0
"""Standard deviation of the finest mean in that image, in its pixels."""
NUM_SCALES = 5
"""Number of scales; each has twice the standard deviation of the one before."""
COARSER_WEIGHT = 0.02
"""Weight of a scale relative to the next finer one: it counts only where that is empty."""
MIN_TRUST = 0.1
"""Weight of a pixel without trust, relative to a trusted one."""


def compute_distance_to_known(known: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Compute the distance to the nearest known pixel, in pixels; one must be known."""
    away = cv2.distanceTransform((~known).numpy().astype(np.uint8), cv2.DIST_L2, 5)
    return torch.from_numpy(away)


def continue_smoothly(
    values: Float[Tensor, "h w c"], weight: Float[Tensor, "h w"]
) -> Float[Tensor, "h w c"]:
    """Fill pixels of zero `weight` with weighted means over a radius that grows inwards.

    Weights are not negative. The largest is not far below 1, and may be far above: a radius with a
    mean weight of at most `MIN_LEVEL_WEIGHT`, whatever the largest one is, counts as empty, and the
    next wider one is taken, or at last the image. Without a positive weight all values are 0.
    Values are finite, also where they have none.
    """
    known = weight > 0
    if not known.any():
        return torch.zeros_like(values)
    # The last channel is the sum of weights that the others are divided by.
    weighted = torch.cat([values * weight[..., None], weight[..., None]], dim=-1).numpy()
    pyramid = build_pyramid(build_sum_pyramid(np.ascontiguousarray(weighted, np.float32)))

    # Each pixel reads the level, between two if need be, whose blur fits its distance: sharp beside
    # the border, wide in the middle of a hole.
    pixels = np.argwhere(~known.numpy())
    distance = compute_distance_to_known(known).numpy()[pixels[:, 0], pixels[:, 1]]
    sigma = SIGMA_PER_DISTANCE * distance
    level = np.log2(np.maximum(sigma / BLUR_SIGMA, 1.0)).clip(0, len(pyramid.starts) - 1)
    filled = values.clone()
    filled[~known] = torch.from_numpy(compute_means(pyramid, pixels, level)).to(values)
    return filled


def build_sum_pyramid(weighted: Float32[ndarray, "h w c"]) -> list[Float32[ndarray, "_ _ c"]]:
    """Build a pyramid of blurred sums; each level has half the size of the previous one."""
    sums = []
    while True:
        blurred = cv2.GaussianBlur(weighted, (0, 0), BLUR_SIGMA)
        sums.append(blurred)
        if min(weighted.shape[:2]) <= 8:
            return sums
        half = ((weighted.shape[1] + 1) // 2, (weighted.shape[0] + 1) // 2)
        # OpenCV averages at most four channels of odd sizes, so they are resized one by one.
        planes = [
            cv2.resize(plane, half, interpolation=cv2.INTER_AREA) for plane in cv2.split(blurred)
        ]
        weighted = np.stack(planes, axis=-1)


def fit_membrane(
    values: Float[Tensor, "h w c"], weight: Float[Tensor, "h w"]
) -> Float[Tensor, "h w c"]:
    """Fit a membrane to `values` by `weight`, in [0, 1]; some pixel must have one.

    It is the likeliest continuation of an image whose spectrum falls with the squared frequency. It
    minimizes Σ FIDELITY w (m - v)² + MEAN_WEIGHT (m - mean)² + Σ (m - m')² over its cells m, where
    v are the values, w their weights, and m' the right and the lower neighbour of m. `values` have
    at most three channels: OpenCV resizes four together, and the weights are one of them.
    """
    # Imported here, since SciPy is slow to import.
    from scipy.sparse import diags, kronsum
    from scipy.sparse.linalg import splu

    # The membrane is smooth, so that a coarse grid is enough: 128 instead of 96 cells gain nothing
    # (decision 042).
    height, width = weight.shape
    scale = min(1.0, MEMBRANE_SIDE / max(height, width))
    rows = max(round(scale * height), 2)
    columns = max(round(scale * width), 2)
    layers = torch.cat([values * weight[..., None], weight[..., None]], dim=-1).numpy()
    cells = cv2.resize(layers, (columns, rows), interpolation=cv2.INTER_AREA)
    sums = cells.reshape(rows * columns, -1).astype(np.float64)

    # The normal equations. The Laplacian of a grid is the Kronecker sum of those of its two sides.
    differences = [diags([-1.0, 1.0], [0, 1], shape=(side - 1, side)) for side in (columns, rows)]
    stiffness = kronsum(*(difference.T @ difference for difference in differences))
    matrix = (stiffness + diags(FIDELITY * sums[:, -1] + MEAN_WEIGHT)).tocsc()
    total = sums.sum(axis=0)
    wanted = FIDELITY * sums[:, :-1] + MEAN_WEIGHT * total[:-1] / total[-1]

    # The matrix is symmetric and positive definite: it needs no pivots, and its entries are ordered
    # as those of a symmetric one.
    solver = splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True})
    fitted = solver.solve(wanted).reshape(rows, columns, -1).astype(np.float32)
    enlarged = cv2.resize(fitted, (width, height), interpolation=cv2.INTER_CUBIC)
    return torch.from_numpy(enlarged.reshape(values.shape))


def average_trusted(render: Render, trust: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """Average the colours of a render around each pixel by trust in [0, 1], at several scales.

    Such a normalized convolution has no structure that could be wrong.
    """
    height, width = trust.shape
    scale = min(1.0, MEANS_SIDE / max(height, width))
    size = (max(round(scale * width), 1), max(round(scale * height), 1))

    # Colours of a render over black are multiplied by alpha already, so that alpha is the weight
    # that goes with them.
    shown = torch.cat([render.image.clamp(0, 1), render.alpha[..., None]], dim=-1)
    weight = MIN_TRUST + (1 - MIN_TRUST) * trust
    layers = (weight[..., None] * shown).cpu().numpy()

    # Sums over all scales are divided once. A coarser scale counts where the finer ones hardly
    # have any weight.
    small = cv2.resize(layers, size, interpolation=cv2.INTER_AREA)
    total: Float32[ndarray, "h w 4"] = np.zeros_like(small, np.float32)
    for level in range(NUM_SCALES):
        mean = cv2.GaussianBlur(small, (0, 0), FIRST_SIGMA * 2**level)
        total += np.float32(COARSER_WEIGHT**level) * mean.astype(np.float32)
    # Far from all colours only the coarsest scales have a weight, which is tiny.
    means = cv2.resize(total[..., :3] / np.maximum(total[..., 3:], 1e-12), (width, height))
    return torch.from_numpy(means).to(render.image).clamp(0, 1)
