"""Exposure gains that make photographs equally bright, per colour channel.

Colours are in [0, 1]. A gain is the factor of all colours of a photograph in one channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.image_ops import BRIGHTEST, DARKEST

MIN_EXPOSURE_PIXELS = 100
"""Fewest pixels that two photographs are compared by, and in each channel the fewest of these that
are neither dark nor clipped."""
MAX_EXPOSURE_GAIN = 2.0
"""Largest plausible gain, to which larger ones are clamped; its inverse is the smallest."""


def match_exposures(
    colors: Sequence[Float[Tensor, "h w 3"]],
    visible: Sequence[Bool[Tensor, "h w"]],
    reference: int,
) -> list[Float[Tensor, "3"]]:
    """Compute the gain by which each photograph gets the exposure of `reference`.

    Args:
        colors: Photographs as seen by one camera, so that equal pixels show one surface.
        visible: True where a photograph shows the surface.
        reference: Index of the photograph whose gain is 1.

    Returns:
        A gain for each photograph. It is 1 for one that shares too few visible pixels with the
        reference, and with all photographs that are matched to it.
    """
    # Each pair is counted once, before the tree asks for it again and again.
    shared = {}
    for i, j in combinations(range(len(colors)), 2):
        shared[i, j] = int((visible[i] & visible[j]).sum())
        shared[j, i] = shared[i, j]
    ones = torch.ones(3, dtype=colors[reference].dtype, device=colors[reference].device)
    gains = {reference: ones}
    waiting = [i for i in range(len(colors)) if i != reference]
    # A photograph that shares nothing with the reference is matched through others, along a maximum
    # spanning tree of shared pixels (Prim's algorithm).
    while waiting:
        pairs = [(i, j) for i in waiting for j in gains]
        best, known = max(pairs, key=lambda pair: shared[pair])
        waiting.remove(best)
        gains[best] = ones
        # All that still wait share less. They may share more with this one, and are then matched
        # to its exposure.
        if shared[best, known] >= MIN_EXPOSURE_PIXELS:
            overlap = visible[best] & visible[known]
            ratio = compute_median_ratio(colors[best][overlap], colors[known][overlap])
            gains[best] = gains[known] * ratio
    return [gains[i].clamp(1 / MAX_EXPOSURE_GAIN, MAX_EXPOSURE_GAIN) for i in range(len(colors))]


def compute_median_ratio(
    own: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]
) -> Float[Tensor, "3"]:
    """Compute the median of `other / own` per channel, over n pixels that show one surface.

    It is 1 in a channel with fewer than `MIN_EXPOSURE_PIXELS` values that are neither dark nor
    clipped in both. A median, since some of the pixels show two surfaces after all.
    """
    ratios = torch.ones_like(own[0])
    for channel in range(3):
        own_values = own[:, channel]
        other_values = other[:, channel]
        is_exposed = torch.minimum(own_values, other_values) > DARKEST
        is_exposed &= torch.maximum(own_values, other_values) < BRIGHTEST
        if int(is_exposed.sum()) >= MIN_EXPOSURE_PIXELS:
            ratios[channel] = (other_values[is_exposed] / own_values[is_exposed]).median()
    return ratios
