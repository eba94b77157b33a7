"""Exposure gains that make photographs equally bright, per colour channel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.image_ops import BRIGHTEST, DARKEST

MIN_EXPOSURE_PIXELS = 100
"""Fewest shared pixels to compare two photographs."""
MAX_EXPOSURE_GAIN = 2.0
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
    gains = {reference: ones}
    waiting = [i for i in range(len(colors)) if i != reference]
    # A photograph that shares nothing with the reference is matched through others, along a maximum
    # spanning tree of shared pixels (Prim's algorithm).
    while waiting:
        pairs = [(i, j, int((visible[i] & visible[j]).sum())) for i in waiting for j in gains]
        best, known, num_shared = max(pairs, key=lambda pair: pair[2])
        waiting.remove(best)
        gains[best] = ones
        if num_shared >= MIN_EXPOSURE_PIXELS:
            overlap = visible[best] & visible[known]
            ratio = compute_median_ratio(colors[best][overlap], colors[known][overlap])
            gains[best] = gains[known] * ratio
    return [gains[i].clamp(1 / MAX_EXPOSURE_GAIN, MAX_EXPOSURE_GAIN) for i in range(len(colors))]


def compute_median_ratio(
    own: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]
) -> Float[Tensor, "3"]:
    """Compute the median of `other / own` per channel; 1 without enough exposed values."""
    ratios = torch.ones_like(own[0])
    for channel in range(3):
        own_values = own[:, channel]
        other_values = other[:, channel]
        is_exposed = torch.minimum(own_values, other_values) > DARKEST
        is_exposed &= torch.maximum(own_values, other_values) < BRIGHTEST
        if int(is_exposed.sum()) >= MIN_EXPOSURE_PIXELS:
            ratios[channel] = (other_values[is_exposed] / own_values[is_exposed]).median()
    return ratios
