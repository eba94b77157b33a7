"""What one view sees past the edge of an object and the others do not lies on the background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from gscompleter.kernels import stereo
from gscompleter.reconstructors.plane_sweep.confidence import MAX_RETURN_ERROR, Map, Mask

UNKNOWN = np.float32(1e-9)
"""Inverse depth of what a view is not sure of."""


@dataclass(frozen=True)
class Neighbour:
    """Another view: what it knows of its depths, and the transforms to and from its pixels."""

    inverse: Float32[np.ndarray, "other_h other_w"]
    """Inverse depths; next to 0 where it is not sure of them."""
    other_from_this: Float32[np.ndarray, "3 4"]
    this_from_other: Float32[np.ndarray, "3 4"]


def hidden_from_others(background: Map, neighbours: Sequence[Neighbour]) -> Mask:
    """Where a surface at inverse depth `background` [h, w] is hidden from some and seen by none.

    A neighbour hides it whose own surface in that direction is nearer.
    """
    hidden = np.zeros(background.shape, bool)
    seen = np.zeros(background.shape, bool)
    for other in neighbours:
        error, ratio = stereo.reproject(
            background, other.inverse, other.other_from_this, other.this_from_other
        )
        known = (error >= 0) & (ratio > 1e-3)
        before = known & (error > MAX_RETURN_ERROR) & (ratio > 1)
        within, _ = stereo.reproject(
            background * ratio, other.inverse, other.other_from_this, other.this_from_other
        )
        hidden |= before & (within >= 0)
        seen |= known & ~before
    return hidden & ~seen
