"""Confidence of stereo matches."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from gscompleter.kernels import stereo

Map = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]

MAX_RETURN_ERROR = 1.5
"""Largest error, in pixels, of a match that is reprojected to the other view and back."""
FULL_MARGIN = 40.0
"""Cost gap between the best and the second best plane that gives full confidence."""
MIN_AREA = 60
"""Smallest patch of similar depth that is not a speckle, in pixels."""
MAX_STEP = 2.0
"""Largest step between neighbouring pixels of one patch, in planes."""


def compute_confidence(index: Map, margin: Map, confirmed: Mask) -> Map:
    """Compute the confidence of each pixel's plane, in [0, 1].

    `margin` is the cost gap to the second best plane; `agrees` marks pixels that another view
    confirms.
    """
    solid = remove_speckles(index, confirmed)
    return (solid * (margin / FULL_MARGIN).clip(0, 1)).astype(np.float32)


def find_consistent(
    inverse: Map,
    other: Float32[np.ndarray, "other_h other_w"],
    other_from_this: Float32[np.ndarray, "3 4"],
    this_from_other: Float32[np.ndarray, "3 4"],
) -> Mask:
    """Mark pixels whose reprojection to the other view and back ends where it began."""
    error, _ = stereo.reproject(inverse, other, other_from_this, this_from_other)
    return (error >= 0) & (error < MAX_RETURN_ERROR)


def remove_speckles(index: Map, mask: Mask) -> Mask:
    """Remove patches of similar depth smaller than `MIN_AREA` pixels from `mask`."""
    # OpenCV takes 16-bit fixed-point disparities; 0 marks masked pixels.
    scale = min(16.0, 30000.0 / max(float(index.max()), 1.0))
    levels = np.where(mask, index.clip(0) * scale + scale, 0).astype(np.int16)
    cv2.filterSpeckles(levels, 0, MIN_AREA, MAX_STEP * scale)
    return levels > 0
