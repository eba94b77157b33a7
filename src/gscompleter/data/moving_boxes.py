"""Masks of moving objects, whose boxes a data set has annotated."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from gscompleter.types import Camera

MIN_CORNER_DEPTH = 0.1
"""Smallest z-depth of the corners of a box, in metres."""
MAX_CORNER_COORDINATE = 1e5
"""Largest pixel coordinate of a projected corner; rasterisers use integers."""


def mask_moving(
    boxes: Float[np.ndarray, "n 8 3"], camera: Camera, origin: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "h w"]:
    """Mask pixels covered by boxes, including occluders in front of them.

    `boxes` are in the world frame of the files, `camera` in coordinates relative to `origin`.
    """
    mask = np.zeros((camera.height, camera.width), np.uint8)
    c2w = camera.c2w.double().cpu().numpy()
    K = camera.K.double().cpu().numpy()
    for corners in boxes - origin:
        # Into camera axes: R^T (corner - centre), written for rows.
        local = (corners - c2w[:3, 3]) @ c2w[:3, :3]
        if np.isfinite(local).all() and local[:, 2].max() > MIN_CORNER_DEPTH:
            # Corners behind the camera have no image. Pulled before it they only make the mask
            # larger.
            local[:, 2] = np.maximum(local[:, 2], MIN_CORNER_DEPTH)
            # OpenCV puts the centre of the first pixel at (0, 0).
            pixels = (local @ K.T)[:, :2] / local[:, 2:] - 0.5
            pixels = np.rint(np.clip(pixels, -MAX_CORNER_COORDINATE, MAX_CORNER_COORDINATE))
            cv2.fillConvexPoly(mask, cv2.convexHull(pixels.astype(np.int32)), 1)
    return mask > 0
