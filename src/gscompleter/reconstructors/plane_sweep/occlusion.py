"""Pixels that only one view observes past an object edge; they lie on the background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from gscompleter.kernels import stereo
from gscompleter.reconstructors.plane_sweep.confidence import MAX_RETURN_ERROR, Map, Mask

UNKNOWN = np.float32(1e-9)
"""Inverse depth of pixels without a confident depth."""


@dataclass(frozen=True)
class Neighbour:
    """Confident depths of another view, and the transforms to and from its pixels."""

    inverse: Float32[np.ndarray, "other_h other_w"]
    other_from_this: Float32[np.ndarray, "3 4"]
    this_from_other: Float32[np.ndarray, "3 4"]


def find_hidden(background: Map, neighbours: Sequence[Neighbour]) -> Mask:
    """Mark background surfaces that some view occludes and no view observes."""
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
