"""Which matches can be trusted, and how far."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from gscompleter.kernels import stereo

Map = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]

MAX_RETURN_ERROR = 1.5
"""Pixels by which a match may miss itself on the way to another view and back."""
FULL_MARGIN = 40.0
"""How much dearer than the best plane the second one must be for full confidence."""
MIN_AREA = 60
"""Pixels of the smallest patch of like depth that is no speckle."""
MAX_STEP = 2.0
"""Planes between neighbours of one patch."""


def confidence_of(index: Map, margin: Map, agrees: Mask) -> Map:
    """In [0, 1]: how much the plane `index` of each pixel counts.

    Args:
        index: The best plane, to a fraction [h, w].
        margin: How much more the second best plane costs [h, w].
        agrees: Where some other view sees the same depth [h, w].
    """
    solid = without_speckles(index, agrees)
    return (solid * (margin / FULL_MARGIN).clip(0, 1)).astype(np.float32)


def consistent(
    inverse: Map,
    other: Float32[np.ndarray, "other_h other_w"],
    other_from_this: Float32[np.ndarray, "3 4"],
    this_from_other: Float32[np.ndarray, "3 4"],
) -> Mask:
    """Where the inverse depths of two views agree: a pixel carried over and back meets itself."""
    error, _ = stereo.reproject(inverse, other, other_from_this, this_from_other)
    return (error >= 0) & (error < MAX_RETURN_ERROR)


def without_speckles(index: Map, mask: Mask) -> Mask:
    """`mask` less its patches of like depth that are smaller than MIN_AREA pixels."""
    # OpenCV takes 16-bit fixed-point disparities; 0 marks what does not count.
    scale = min(16.0, 30000.0 / max(float(index.max()), 1.0))
    levels = np.where(mask, index.clip(0) * scale + scale, 0).astype(np.int16)
    cv2.filterSpeckles(levels, 0, MIN_AREA, MAX_STEP * scale)
    return levels > 0
