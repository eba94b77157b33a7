"""Order along a Morton curve: Gaussians close in space are close in memory."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy import ndarray
from torch import Tensor

from gscompleter.numerics.kernels.splat_rows import permute_rows
from gscompleter.types import Gaussians

BITS_PER_AXIS = 21
BOUNDS_SAMPLE = 100_000
"""Gaussians from which the bounds of the scene are estimated."""


def argsort_nearby(gaussians: Gaussians) -> Int64[Tensor, "n"]:
    """Compute the order along the curve; outliers count as lying at the border."""
    means = gaussians.means.detach().cpu().double().numpy()
    low, high = np.quantile(means[:: max(1, len(means) // BOUNDS_SAMPLE)], (0.01, 0.99), axis=0)
    return argsort_morton(means, low, high).to(gaussians.means.device)


def sort_nearby(gaussians: Gaussians) -> Int64[Tensor, "n"]:
    """Sort Gaussians on the CPU along the curve in their own memory; return the order.

    For what was just read and that nobody else holds: a sorted copy would take as much again.
    """
    order = argsort_nearby(gaussians)
    count = len(order)
    encoded = torch.empty(count, 0) if gaussians.encoded is None else gaussians.encoded
    values = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    rows = [value.numpy().reshape(count, -1) for value in values]
    permute_rows(order.numpy(), *rows, encoded.numpy(), np.zeros(count, np.bool_))
    gaussians.generated.copy_(gaussians.generated[order])
    return order


def sort_along_morton(gaussians: Gaussians) -> Gaussians:
    """Sort Gaussians along the curve, so that each chunk is compact in space."""
    return gaussians[argsort_all(gaussians.means)]


def argsort_all(means: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
    """Compute the order along the curve through the box of all positions, that of sorted files."""
    places = means.double().numpy()
    return argsort_morton(places, places.min(0), places.max(0))


def argsort_morton(
    means: Float[ndarray, "n 3"], low: Float[ndarray, "3"], high: Float[ndarray, "3"]
) -> Int64[Tensor, "n"]:
    """Compute the order of positions along the curve through a box; the sort is stable."""
    extent = np.maximum(high - low, np.finfo(np.float64).tiny)
    cells = (((means - low) / extent).clip(0, 1) * (2**BITS_PER_AXIS - 1)).astype(np.int64)
    # The code has the bits of the axes in turn; a table spreads 11 bits of an axis at a time, with
    # two zeros above each.
    numbers = np.arange(2**11)
    spread = np.zeros(2**11, np.int64)
    for bit in range(11):
        spread |= ((numbers >> bit) & 1) << (3 * bit)
    code = np.zeros(len(cells), np.int64)
    for axis, cell in enumerate(cells.T):
        code |= (spread[cell & 2047] | (spread[cell >> 11] << 33)) << axis
    # torch sorts three times as fast as numpy. Codes of 63 bits fit into int64.
    return torch.from_numpy(code).argsort(stable=True)
