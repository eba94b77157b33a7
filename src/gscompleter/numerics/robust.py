"""Robust fits of lines: RANSAC (Fischler and Bolles 1981) for depths, trimming for colours."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MAX_TRIALS = 512
"""Two-point hypotheses."""
HYPOTHESES_PER_BATCH = 32
"""Hypotheses that are scored together, so few that their residuals stay in the cache."""
RESIDUAL_THRESHOLD = 0.05
"""Largest residual of an inlier, relative to `y`."""
TRIMMED_ROUNDS = 5
"""Number of trimmed fits; each one leaves out the outliers of the previous one."""


def find_affine_inliers(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], scale: float, shift: float
) -> Bool[Tensor, "n"]:
    """Find pixels with a small residual, relative to `y`."""
    return (scale * x + shift - y).abs() < RESIDUAL_THRESHOLD * y


def fit_line_ransac(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], rng: torch.Generator
) -> tuple[float, float]:
    """Fit scale and shift to the most inliers of two-point hypotheses, then refit them.

    Residuals are relative to depth, so that distant pixels do not dominate. Returns (0, 0) if no
    hypothesis has a positive scale.
    """
    i, j = torch.randint(len(x), (2, MAX_TRIALS), generator=rng).to(x.device)
    scales = (y[i] - y[j]) / torch.where(x[i] == x[j], torch.inf, x[i] - x[j])
    shifts = y[i] - scales * x[i]
    points = torch.stack([x / y, 1 / y])
    batches = torch.stack([scales, shifts], dim=1).split(HYPOTHESES_PER_BATCH)
    residuals = ((batch @ points).sub_(1).abs_() for batch in batches)
    counts = torch.cat([(each < RESIDUAL_THRESHOLD).sum(dim=1) for each in residuals])
    best = counts.where(scales > 0, -1).argmax()
    if scales[best] <= 0:
        return 0.0, 0.0

    scale, shift = scales[best].item(), shifts[best].item()
    for _ in range(3):
        agree = find_affine_inliers(x, y, scale, shift)
        weight = 1 / y[agree]
        design = torch.stack([x[agree], torch.ones_like(x[agree])], dim=-1) * weight[:, None]
        # Unlike lstsq, the normal equations are solved in closed form on any device.
        normal = design.T @ design
        # The second column is in inverse depths; scaling makes the condition independent of units.
        even = torch.stack([torch.ones_like(x[0]), y.median()])
        if torch.linalg.cond(normal * even * even[:, None]) > 1e12:
            break
        scale, shift = torch.linalg.solve(normal, design.T @ (y[agree] * weight)).tolist()
    return scale, shift


def fit_robust_affine(
    x: Float[Tensor, "n c"], y: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "c"], Float[Tensor, "c"]]:
    """Fit `y = gain * x + offset` per channel by trimmed least squares, starting at gain 1.

    Residuals above 2.5 standard deviations are dropped; a constant channel keeps about gain 1.
    """
    gain = torch.ones_like(x[0])
    offset = (y - x).median(dim=0).values
    for _ in range(TRIMMED_ROUNDS):
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
