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
