"""Exposure gains that make photographs equally bright, per colour channel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_PIXELS = 100
"""Fewest shared pixels to compare two photographs."""
DARKEST, BRIGHTEST = 0.05, 0.95
"""Range of usable values; darker ones are noise, brighter ones may be clipped."""
MAX_GAIN = 2.0
"""Largest plausible gain; its inverse is the smallest."""
ROUNDS = 5
"""Number of robust fits; each one leaves out the outliers of the previous one."""


def match_exposures(
    colors: Sequence[Float[Tensor, "h w 3"]],
    visible: Sequence[Bool[Tensor, "h w"]],
    reference: int,
) -> list[Float[Tensor, "3"]]:
    """Compute factors that match each photograph to the exposure of `reference`.

    The pairs that share most `visible` pixels are matched first; others keep a gain of 1.
    """
    ones = torch.ones(3, dtype=colors[reference].dtype, device=colors[reference].device)
    found = {reference: ones}
    waiting = [i for i in range(len(colors)) if i != reference]
    while waiting:
        pairs = [(i, j, int((visible[i] & visible[j]).sum())) for i in waiting for j in found]
        best, known, shared = max(pairs, key=lambda pair: pair[2])
        waiting.remove(best)
        overlap = visible[best] & visible[known]
        found[best] = ones
        if shared >= MIN_PIXELS:
            own, other = colors[best][overlap], colors[known][overlap]
            found[best] = found[known] * compute_median_ratio(own, other)
    return [found[i].clamp(1 / MAX_GAIN, MAX_GAIN) for i in range(len(colors))]


def compute_median_ratio(
    own: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]
) -> Float[Tensor, "3"]:
    """Compute the median of `other / own` per channel; 1 without enough exposed values."""
    ratios = torch.ones_like(own[0])
    for channel in range(3):
        a, b = own[:, channel], other[:, channel]
        exposed = (torch.minimum(a, b) > DARKEST) & (torch.maximum(a, b) < BRIGHTEST)
        if int(exposed.sum()) >= MIN_PIXELS:
            ratios[channel] = (b[exposed] / a[exposed]).median()
    return ratios


def fit_robust_affine(
    x: Float[Tensor, "n c"], y: Float[Tensor, "n c"]
) -> tuple[Float[Tensor, "c"], Float[Tensor, "c"]]:
    """Fit `y = gain * x + offset` per channel by trimmed least squares, starting at gain 1.

    Residuals above 2.5 standard deviations are dropped; a constant channel keeps about gain 1.
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
