"""Make photographs equally bright: one gain for each colour channel, from what they share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_PIXELS = 100
"""Fewest pixels that two photographs must share for their gains to be compared."""
DARKEST = 0.05
"""Values below say nothing about a gain, for noise rules them."""
BRIGHTEST = 0.95
"""Values above say nothing about a gain, for they may be clipped."""
MAX_GAIN = 2.0
"""Largest gain, and its inverse the smallest, that a difference of exposure explains."""


def gains(
    colours: Sequence[Float[Tensor, "h w 3"]],
    visible: Sequence[Bool[Tensor, "h w"]],
    reference: int,
) -> list[Float[Tensor, "3"]]:
    """Factors that bring each photograph to the exposure of the one numbered `reference`.

    Args:
        colours: What each photograph shows at the same surfaces.
        visible: Where it shows them.
        reference: Index of the photograph that stays as it is.

    The median ratio over the shared surfaces does not mind reflections and wrong depths. A
    photograph that shares too little with the reference is compared with one already brought to
    its exposure, and left alone where there is none.
    """
    ones = torch.ones(3, dtype=colours[reference].dtype, device=colours[reference].device)
    found = {reference: ones}
    waiting = [i for i in range(len(colours)) if i != reference]
    while waiting:
        pairs = [(i, j, int((visible[i] & visible[j]).sum())) for i in waiting for j in found]
        best, known, shared = max(pairs, key=lambda pair: pair[2])
        waiting.remove(best)
        overlap = visible[best] & visible[known]
        found[best] = ones
        if shared >= MIN_PIXELS:
            own, other = colours[best][overlap], colours[known][overlap]
            found[best] = found[known] * median_ratio(own, other)
    return [found[i].clamp(1 / MAX_GAIN, MAX_GAIN) for i in range(len(colours))]


def median_ratio(own: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """Median of `other / own` for each channel, over well exposed values; 1 where these lack."""
    ratios = torch.ones_like(own[0])
    for channel in range(3):
        a, b = own[:, channel], other[:, channel]
        exposed = (torch.minimum(a, b) > DARKEST) & (torch.maximum(a, b) < BRIGHTEST)
        if int(exposed.sum()) >= MIN_PIXELS:
            ratios[channel] = (b[exposed] / a[exposed]).median()
    return ratios
