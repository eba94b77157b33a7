"""Robust fits: RANSAC (Fischler and Bolles 1981) for depths, trimmed least squares for colours.

Depths are in any unit, and may be inverse depths; they are positive unless a function says more.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MAX_HYPOTHESES = 512
"""Lines that are tried, each through two points."""
HYPOTHESES_PER_BATCH = 32
"""Hypotheses that are scored together, so few that their residuals stay in the cache."""
RESIDUAL_THRESHOLD = 0.05
"""Largest residual of an inlier, relative to `y`: far pixels do not dominate."""
MAX_CONDITION = 1e12
"""Largest condition of normal equations in float64 that leaves some digits of the solution."""
REFIT_ROUNDS = 3
"""Rounds in which a line or a scale is fitted to its inliers, whose set changes with it."""
NUM_RATIOS = 100
"""Quantiles of the ratios of depths that are tried as their scale."""
TRIMMED_ROUNDS = 5
"""Number of trimmed fits; each one leaves out the outliers of the previous one."""
MAX_DEVIATIONS = 2.5
"""Largest residual of a trimmed fit, in standard deviations."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal errors over the median of their absolute values."""
MIN_DEVIATION = 1e-3
"""Smallest standard deviation, of colours in [0, 1]: of equal colours all are kept."""
GAIN_VARIANCE = 1e-4
"""Variance of colours in [0, 1] at which a gain is halfway between 1 and that of the samples."""


def find_affine_inliers(
    x: Float[Tensor, "n"], y: Float[Tensor, "n"], scale: float, shift: float
) -> Bool[Tensor, "n"]:
    """Mark samples at which `scale * x + shift` is `y` up to `RESIDUAL_THRESHOLD` of it."""
    return (scale * x + shift - y).abs() < RESIDUAL_THRESHOLD * y


def fit_line_ransac(
    x: Float[Tensor, "n"],
    y: Float[Tensor, "n"],
    rng: torch.Generator,
    device: torch.device | None = None,
) -> tuple[float, float]:
    """Fit `y = scale * x + shift` by RANSAC, and refit it to its inliers.

    Args:
        x: Samples in float64, at least one; inverse depths may be 0.
        y: Positive values of the line, in float64.
        rng: Generator on the CPU that draws the hypotheses.
        device: Where hypotheses are scored; None for the device of `x`.

    Returns:
        Scale and shift. (0, 0) if no hypothesis has a positive scale. The refit may end at a
        negative scale where `y` hardly depends on `x`, which is for the caller to refuse.
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

    # Least squares on the inliers, of residuals relative to y.
    scale = scales[best].item()
    shift = shifts[best].item()
    for _ in range(REFIT_ROUNDS):
        agree = find_affine_inliers(x, y, scale, shift)
        weight = 1 / y[agree]
        design = torch.stack([x[agree], torch.ones_like(x[agree])], dim=-1) * weight[:, None]
        # Unlike lstsq, the normal equations are solved in closed form on any device.
        normal = design.T @ design
        # Columns of length 1 make the condition independent of the units of x and y.
        even = normal.diagonal().clamp_min(torch.finfo(normal.dtype).tiny).rsqrt()
        # Equal x leave scale and shift open: the line stays as it was.
        if torch.linalg.cond(normal * even * even[:, None]) > MAX_CONDITION:
            break
        scale, shift = torch.linalg.solve(normal, design.T @ (y[agree] * weight)).tolist()
    return scale, shift


def fit_scale(x: Float[Tensor, "n"], y: Float[Tensor, "n"]) -> float:
    """Fit the scale of `y = scale * x` with the most inliers, from at least one sample.

    It is the median ratio of its inliers. The median of all ratios would be off where many pixels
    show different surfaces.
    """
    ratios = y / x
    levels = torch.arange(0.5, NUM_RATIOS, dtype=x.dtype, device=x.device) / NUM_RATIOS
    scales = ratios.quantile(levels)
    counts = torch.stack([find_affine_inliers(x, y, scale, 0.0).sum() for scale in scales.tolist()])
    scale = scales[counts.argmax()].item()
    for _ in range(REFIT_ROUNDS):
        scale = ratios[find_affine_inliers(x, y, scale, 0.0)].median().item()
    return scale


def fit_robust_affine(
    x: Float[Tensor, "n c"], y: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "c"], Float[Tensor, "c"]]:
    """Fit `y = gain * x + offset` per channel by trimmed least squares, starting at gain 1.

    Values are colours in [0, 1], or have a spread like theirs. Samples far off are left out,
    channel by channel. A constant channel keeps about gain 1. Without samples, as of a photograph
    that masks hide altogether, it is the identity.
    """
    gain = x.new_ones(x.shape[1])
    if len(x) == 0:
        return gain, torch.zeros_like(gain)
    offset = (y - x).median(dim=0).values
    for _ in range(TRIMMED_ROUNDS):
        error = (gain * x + offset - y).abs()
        sigma = MAD_TO_SIGMA * error.median(dim=0).values
        weight = (error <= MAX_DEVIATIONS * sigma.clamp_min(MIN_DEVIATION)).to(x)
        total = weight.sum(dim=0).clamp_min(1.0)
        mean_x = (weight * x).sum(dim=0) / total
        mean_y = (weight * y).sum(dim=0) / total
        centred_x = x - mean_x
        centred_y = y - mean_y
        variance = (weight * centred_x * centred_x).sum(dim=0) / total
        covariance = (weight * centred_x * centred_y).sum(dim=0) / total
        # The constant pulls the gain towards 1 where the channel hardly varies.
        gain = (covariance + GAIN_VARIANCE) / (variance + GAIN_VARIANCE)
        offset = mean_y - gain * mean_x
    return gain, offset
