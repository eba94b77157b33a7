"""A line through points of which some are wrong."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

ROUNDS = 5
"""Fits of the line; each leaves out what disagrees with the one before."""


def robust_affine(
    x: Float[Tensor, "n c"], y: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "c"], Float[Tensor, "c"]]:
    """`gain` and `offset` of each channel with `y = gain * x + offset`, by trimmed least squares.

    It starts from a gain of 1, and `x` and `y` should be of the order of 1. Points off by more than
    2.5 times the usual difference are left out of the next round. Where a channel hardly varies,
    its gain cannot be told from its offset, and stays near 1.
    """
    gain = torch.ones_like(x[0])
    offset = (y - x).median(dim=0).values
    for _ in range(ROUNDS):
        error = (gain * x + offset - y).abs()
        usual = 1.4826 * error.median(dim=0).values
        weight = (error <= 2.5 * usual.clamp_min(1e-3)).to(x)
        total = weight.sum(dim=0).clamp_min(1.0)
        mean_x, mean_y = (weight * x).sum(dim=0) / total, (weight * y).sum(dim=0) / total
        a, b = x - mean_x, y - mean_y
        variance = (weight * a * a).sum(dim=0) / total
        gain = ((weight * a * b).sum(dim=0) / total + 1e-4) / (variance + 1e-4)
        offset = mean_y - gain * mean_x
    return gain, offset
