"""Gaussians along a Morton curve: those that lie near each other in space do so in memory."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt64
from numpy import ndarray
from torch import Tensor

from gscompleter.types import Gaussians

BITS = 21
"""Of each axis; those of all three make one number of 63 bits."""
SPREADING = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts, and the bits that stay after each, that leave room for two between any two of them."""
SAMPLE = 100_000
"""Gaussians by which it is known where most of all lie."""


def order_nearby(gaussians: Gaussians) -> Int64[Tensor, "n"]:
    """The order in which Gaussians lie along the curve. What is far outside of all others counts as
    at their border."""
    means = gaussians.means.detach().cpu().double().numpy()
    low, high = np.quantile(means[:: max(1, len(means) // SAMPLE)], (0.01, 0.99), axis=0)
    return curve_order(means, low, high).to(gaussians.means.device)


def near_together(gaussians: Gaussians) -> Gaussians:
    """The Gaussians along the curve, so that those of a chunk lie close to each other."""
    means = gaussians.means.double().numpy()
    return gaussians[curve_order(means, means.min(0), means.max(0))]


def curve_order(
    means: Float[ndarray, "n 3"], low: Float[ndarray, "3"], high: Float[ndarray, "3"]
) -> Int64[Tensor, "n"]:
    """The order of places along the curve through a box; equal ones stay in theirs."""
    extent = np.maximum(high - low, np.finfo(np.float64).tiny)
    cells = (((means - low) / extent).clip(0, 1) * (2**BITS - 1)).astype(np.uint64)
    code = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        code |= spread(cells[:, axis]) << np.uint64(axis)
    # torch sorts in a third of the time. The codes have 63 bits, which leaves the sign.
    return torch.from_numpy(code.view(np.int64)).argsort(stable=True)


def spread(numbers: UInt64[ndarray, "n"]) -> UInt64[ndarray, "n"]:
    """Numbers of `BITS` bits with two zeros behind each bit."""
    for shift, mask in SPREADING:
        numbers = (numbers | (numbers << np.uint64(shift))) & np.uint64(mask)
    return numbers
