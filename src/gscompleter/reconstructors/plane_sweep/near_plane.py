"""The near plane of a sweep, brought forward where surfaces stand before it.

Features say nothing of a white wall or of the smooth arm of a chair. So a sweep of small images
reaches to half the distance of the near plane, and what it measures there and another photograph
confirms stands before it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gscompleter.numerics.image_ops import MIN_CONTRAST
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.rig import Rig, build_rig
from gscompleter.reconstructors.plane_sweep.sweep import MIN_GUIDED_SIDE, Mask, measure_depths
from gscompleter.types import View

MIN_NEARER_SHARE = 0.01
"""Share of a photograph that has to be measured before the near plane."""
MAX_STEPS = 3
"""Most times that the distance of the near plane is halved."""


def find_near_plane(views: Sequence[View], near: float, far: float, device: str = "cpu") -> float:
    """Halve the distance of the near plane, in scene units, while surfaces stand before it.

    Small images tell it in the time of a few percent of a reconstruction.
    """
    rig = build_rig(views, device)
    while min(min(image.size) for image in rig.images) >= MIN_GUIDED_SIDE:
        rig = rig.halve()
    for _ in range(MAX_STEPS):
        if measure_share_before(rig, near, far) < MIN_NEARER_SHARE:
            break
        near /= 2
    return near


def measure_share_before(rig: Rig, near: float, far: float) -> float:
    """Measure how much of a photograph stands before the near plane, the most of all."""
    shares = []
    for image, measured in zip(rig.images, measure_depths(rig, near / 2, far), strict=True):
        # Depths that another photograph confirms have a confidence. Two even areas confirm any.
        is_before = (measured.confidence > 0) & (measured.inverse > rig.unit / near)
        is_before &= find_texture(image)
        if image.ignore_mask is not None:
            is_before &= ~image.ignore_mask
        shares.append(float(is_before.mean()))
    return max(shares)


def find_texture(image: StereoImage) -> Mask:
    """Find pixels with some texture around them; shading and edges are enough."""
    smooth = cv2.blur(image.image.mean(axis=-1).astype(np.float32), (3, 3))
    window = np.ones((5, 5), np.uint8)
    contrast = cv2.dilate(smooth, window) - cv2.erode(smooth, window)
    is_textured: Mask = contrast > MIN_CONTRAST
    return is_textured
