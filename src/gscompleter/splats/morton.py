"""Order along a Morton curve: Gaussians close in space are close in memory."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt64
from numpy import ndarray
from torch import Tensor

from gscompleter.types import Gaussians

BITS_PER_AXIS = 21
SPREAD_STEPS = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that insert two zeros after each bit."""
SAMPLE_SIZE = 100_000
"""Gaussians from which the bounds of the scene are estimated."""


def argsort_nearby(gaussians: Gaussians) -> Int64[Tensor, "n"]:
    """Compute the order along the curve; outliers count as lying at the border."""
    means = gaussians.means.detach().cpu().double().numpy()
    low, high = np.quantile(means[:: max(1, len(means) // SAMPLE_SIZE)], (0.01, 0.99), axis=0)
    return argsort_morton(means, low, high).to(gaussians.means.device)


def sort_along_morton(gaussians: Gaussians) -> Gaussians:
    """Sort Gaussians along the curve, so that each chunk is compact in space."""
    means = gaussians.means.double().numpy()
    return gaussians[argsort_morton(means, means.min(0), means.max(0))]


def argsort_morton(
    means: Float[ndarray, "n 3"], low: Float[ndarray, "3"], high: Float[ndarray, "3"]
) -> Int64[Tensor, "n"]:
    """Compute the order of positions along the curve through a box; the sort is stable."""
    extent = np.maximum(high - low, np.finfo(np.float64).tiny)
    cells = (((means - low) / extent).clip(0, 1) * (2**BITS_PER_AXIS - 1)).astype(np.uint64)
    code = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        code |= spread_bits(cells[:, axis]) << np.uint64(axis)
    # torch sorts three times as fast as numpy. Codes of 63 bits fit into int64.
    return torch.from_numpy(code.view(np.int64)).argsort(stable=True)


def spread_bits(numbers: UInt64[ndarray, "n"]) -> UInt64[ndarray, "n"]:
    """Insert two zeros after each of the `BITS_PER_AXIS` bits of the numbers."""
    for shift, mask in SPREAD_STEPS:
        numbers = (numbers | (numbers << np.uint64(shift))) & np.uint64(mask)
    return numbers
