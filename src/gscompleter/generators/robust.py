"""Robust fit of a line."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

ROUNDS = 5
"""Number of fits; each one leaves out the outliers of the previous one."""


def fit_robust_affine(
    x: Float[Tensor, "n c"], y: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "c"], Float[Tensor, "c"]]:
    """Fit `y = gain * x + offset` per channel by trimmed least squares, starting at gain 1.

    Residuals above 2.5 standard deviations are dropped; the gain of a constant channel stays close
    to 1.
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
