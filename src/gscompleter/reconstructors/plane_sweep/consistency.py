"""Depths of a view compared with those of other views: confidence and occlusion."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from gscompleter.kernels import stereo
from gscompleter.reconstructors.plane_sweep.rig import Transform

Map = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Neighbour = tuple[Float32[np.ndarray, "other_h other_w"], Transform, Transform]
"""Inverse depths of another view, and the transforms to its pixels and back."""

MAX_RETURN_ERROR = 1.5
"""Largest error, in pixels, of a match that is reprojected to the other view and back."""
FULL_MARGIN = 40.0
"""Cost gap between the best and the second best plane that gives full confidence."""
MIN_AREA = 60
"""Smallest patch of similar depth that is not a speckle, in pixels."""
MAX_STEP = 2.0
"""Largest step between neighbouring pixels of one patch, in planes."""
UNKNOWN = np.float32(1e-9)
"""Inverse depth of pixels without a confident depth."""


def find_consistent(inverse: Map, neighbour: Neighbour) -> Mask:
    """Mark pixels whose reprojection to the other view and back ends where it began."""
    error, _ = stereo.reproject(inverse, *neighbour)
    return (error >= 0) & (error < MAX_RETURN_ERROR)


def compute_confidence(index: Map, margin: Map, confirmed: Mask) -> Map:
    """Compute the confidence of each pixel's plane, in [0, 1].

    `margin` is the cost gap to the second best plane; `confirmed` marks pixels that another view
    confirms.
    """
    solid = remove_speckles(index, confirmed)
    return (solid * (margin / FULL_MARGIN).clip(0, 1)).astype(np.float32)


def remove_speckles(index: Map, mask: Mask) -> Mask:
    """Remove patches of similar depth smaller than `MIN_AREA` pixels from `mask`."""
    # OpenCV takes 16-bit fixed-point disparities; 0 marks masked pixels.
    scale = min(16.0, 30000.0 / max(float(index.max()), 1.0))
    levels = np.where(mask, index.clip(0) * scale + scale, 0).astype(np.int16)
    cv2.filterSpeckles(levels, 0, MIN_AREA, MAX_STEP * scale)
    return levels > 0


def find_hidden(background: Map, neighbours: Sequence[Neighbour]) -> Mask:
    """Mark background surfaces that some view occludes and no view observes."""
    hidden = np.zeros(background.shape, bool)
    seen = np.zeros(background.shape, bool)
    for neighbour in neighbours:
        error, ratio = stereo.reproject(background, *neighbour)
        known = (error >= 0) & (ratio > 1e-3)
        before = known & (error > MAX_RETURN_ERROR) & (ratio > 1)
        within, _ = stereo.reproject(background * ratio, *neighbour)
        hidden |= before & (within >= 0)
        seen |= known & ~before
    return hidden & ~seen
