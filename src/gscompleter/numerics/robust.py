"""Robust fits: RANSAC (Fischler and Bolles 1981) for depths and planes, trimming for colours."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MAX_HYPOTHESES = 512
"""Two-point hypotheses."""
HYPOTHESES_PER_BATCH = 32
"""Hypotheses that are scored together, so few that their residuals stay in the cache."""
RESIDUAL_THRESHOLD = 0.05
"""Largest residual of an inlier, relative to `y`."""
NUM_RATIOS = 100
"""Quantiles of the ratios of depths that are tried as their scale."""
SCALE_ROUNDS = 3
"""Rounds in which a scale is fitted to its inliers, whose set changes with it."""
TRIMMED_ROUNDS = 5
"""Number of trimmed fits; each one leaves out the outliers of the previous one."""


def find_affine_inliers(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], scale: float, shift: float
) -> Bool[Tensor, "n"]:
    """Find pixels with a small residual, relative to `y`."""
    return (scale * x + shift - y).abs() < RESIDUAL_THRESHOLD * y


def fit_line_ransac(
    x: Float[Tensor, "n"],
    y: Float[Tensor, "n"],
    rng: torch.Generator,
    device: torch.device | None = None,
) -> tuple[float, float]:
    """Fit scale and shift to the most inliers of two-point hypotheses, then refit them.

    Residuals are relative to depth, so that distant pixels do not dominate. Returns (0, 0) if no
    hypothesis has a positive scale. Hypotheses are scored on `device`, by default that of `x`.
    """
    device = device or x.device
    # A line through two points each. Equal x give a scale of 0, which no hypothesis may have.
    i, j = torch.randint(len(x), (2, MAX_HYPOTHESES), generator=rng).to(x.device)
    scales = (y[i] - y[j]) / torch.where(x[i] == x[j], torch.inf, x[i] - x[j])
    shifts = y[i] - scales * x[i]
    # (scale x + shift - y) / y = scale (x / y) + shift (1 / y) - 1, for all pairs in one product.
    points = torch.stack([x / y, 1 / y]).to(device, non_blocking=True)
    lines = torch.stack([scales, shifts], dim=1).to(device, non_blocking=True)
    counts = []
    for batch in lines.split(HYPOTHESES_PER_BATCH):
        residuals = (batch @ points).sub_(1).abs_()
        counts.append((residuals < RESIDUAL_THRESHOLD).sum(dim=1))
    best = torch.cat(counts).to(x.device).where(scales > 0, -1).argmax()
    if scales[best] <= 0:
        return 0.0, 0.0

    # Least squares on the inliers, whose set changes with the line.
    scale = scales[best].item()
    shift = shifts[best].item()
    for _ in range(3):
        agree = find_affine_inliers(x, y, scale, shift)
        weight = 1 / y[agree]
        design = torch.stack([x[agree], torch.ones_like(x[agree])], dim=-1) * weight[:, None]
        # Unlike lstsq, the normal equations are solved in closed form on any device.
        normal = design.T @ design
        # Columns of length 1 make the condition independent of the units of x and y.
        even = normal.diagonal().clamp_min(torch.finfo(normal.dtype).tiny).rsqrt()
        if torch.linalg.cond(normal * even * even[:, None]) > 1e12:
            break
        scale, shift = torch.linalg.solve(normal, design.T @ (y[agree] * weight)).tolist()
    return scale, shift


def fit_scale(x: Float[Tensor, "n"], y: Float[Tensor, "n"]) -> float:
    """Fit the scale of `y = scale * x` with the most inliers, both being positive.

    It is the median ratio of its inliers. The median of all ratios would be off where many pixels
    show different surfaces.
    """
    ratios = y / x
    levels = torch.arange(0.5, NUM_RATIOS, dtype=x.dtype, device=x.device) / NUM_RATIOS
    scales = ratios.quantile(levels)
    counts = torch.stack([find_affine_inliers(x, y, scale, 0.0).sum() for scale in scales.tolist()])
    scale = scales[counts.argmax()].item()
    for _ in range(SCALE_ROUNDS):
        scale = ratios[find_affine_inliers(x, y, scale, 0.0)].median().item()
    return scale


def fit_robust_affine(
    x: Float[Tensor, "n c"], y: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "c"], Float[Tensor, "c"]]:
    """Fit `y = gain * x + offset` per channel by trimmed least squares, starting at gain 1.

    Residuals above 2.5 standard deviations are dropped; a constant channel keeps about gain 1.
    Without samples it is the identity.
    """
    gain = x.new_ones(x.shape[1])
    if len(x) == 0:
        return gain, torch.zeros_like(gain)
    offset = (y - x).median(dim=0).values
    for _ in range(TRIMMED_ROUNDS):
        error = (gain * x + offset - y).abs()
        sigma = 1.4826 * error.median(dim=0).values
        weight = (error <= 2.5 * sigma.clamp_min(1e-3)).to(x)
        total = weight.sum(dim=0).clamp_min(1.0)
        mean_x = (weight * x).sum(dim=0) / total
        mean_y = (weight * y).sum(dim=0) / total
        centred_x = x - mean_x
        centred_y = y - mean_y
        variance = (weight * centred_x * centred_x).sum(dim=0) / total
        covariance = (weight * centred_x * centred_y).sum(dim=0) / total
        # The two constants pull the gain towards 1 where the channel hardly varies.
        gain = (covariance + 1e-4) / (variance + 1e-4)
        offset = mean_y - gain * mean_x
    return gain, offset
