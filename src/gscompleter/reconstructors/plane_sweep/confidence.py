"""Which matches can be trusted, and how far."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from gscompleter.kernels import stereo

Map = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class ConfidenceConfig:
    max_return_error: float = 1.5
    """Pixels by which a match may miss itself on the way to another view and back."""
    full_margin: float = 40.0
    """How much dearer than the best plane the second one must be for full confidence."""
    min_area: int = 60
    """Pixels of the smallest patch of like depth that is no accident."""
    max_step: float = 2.0
    """Planes between neighbours of one patch."""
    of_background: float = 0.3
    """Of the background's depth where an object hides it from the other views."""


def confidence_of(index: Map, margin: Map, agrees: Mask, config: ConfidenceConfig) -> Map:
    """In [0, 1]: how much the plane `index` of each pixel counts.

    Args:
        index: The best plane, to a fraction [h, w].
        margin: How much more the second best plane costs [h, w].
        agrees: Where some other view sees the same depth [h, w].
        config: Limits.
    """
    solid = without_specks(index, agrees, config.min_area, config.max_step)
    return (solid * (margin / config.full_margin).clip(0, 1)).astype(np.float32)


def agreement(
    inverse: Map,
    other: Float32[np.ndarray, "other_h other_w"],
    there: Float32[np.ndarray, "3 4"],
    back: Float32[np.ndarray, "3 4"],
    config: ConfidenceConfig,
) -> Mask:
    """Where the inverse depths of two views agree: a pixel carried over and back meets itself."""
    error, _ = stereo.reproject(inverse, other, there, back)
    return (error >= 0) & (error < config.max_return_error)


def without_specks(index: Map, mask: Mask, min_area: int, max_step: float) -> Mask:
    """`mask` less its patches of like depth that are smaller than `min_area` pixels."""
    # OpenCV takes 16-bit fixed-point disparities; 0 marks what does not count.
    scale = min(16.0, 30000.0 / max(float(index.max()), 1.0))
    levels = np.where(mask, index.clip(0) * scale + scale, 0).astype(np.int16)
    cv2.filterSpeckles(levels, 0, min_area, max_step * scale)
    return levels > 0
