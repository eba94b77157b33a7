"""Depth that is given with a photograph, as a measurement instead of stereo."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.sweep import (
    MAX_PLANES,
    Map,
    Mask,
    Measurement,
    compute_plane_index,
)
from gscompleter.types import View

WEIGHT = np.float32(1)
"""Weight of a given depth in the surface fit, that of the most confident stereo."""
NEAREST = np.float32(1e-6)
"""Smallest depth, in units of the images; sensors write any number."""
NEAR_RADIUS = 10
"""Distance in pixels within which given depths are compared with stereo."""
MAX_DIFFERENCE = 1.0
"""Difference in planes from which stereo contradicts a given depth."""
MIN_CONTRADICTING = 2.5
"""More than so many given depths have to contradict stereo: a triangulated point may be wrong."""


def add_given(found: Measurement, view: View, unit: float) -> Measurement:
    """Use given depths instead of stereo, and no stereo beside those that mostly contradict it.

    `unit` is the length of 1 in `found`, in scene units.
    """
    if view.given_depth is None:
        return found
    depth = view.given_depth.cpu().numpy()
    full, known = found.resize_to(depth.shape), depth > 0
    inverse = (unit / np.maximum(depth, NEAREST * unit)).astype(np.float32)
    index = compute_plane_index(full.planes, inverse).clip(-1, len(full.planes))
    kept = full.exclude(find_contradicted(full, index, known))
    return replace(
        kept,
        index=np.where(known, index, kept.index),
        weight=np.where(known, WEIGHT, kept.weight),
        confidence=np.where(known, np.float32(1), kept.confidence),
    )


def find_contradicted(found: Measurement, index: Map, known: Mask) -> Mask:
    """Find pixels around which most given depths, and not just a few, contradict stereo."""
    compared = known & (found.confidence > 0)
    wrong = compared & (np.abs(found.index - index) > MAX_DIFFERENCE)
    window = (2 * NEAR_RADIUS + 1,) * 2
    total, bad = (cv2.boxFilter(m.astype(np.float32), -1, window) for m in (compared, wrong))
    return bad > np.maximum(total / 2, MIN_CONTRADICTING / window[0] ** 2)


def measure_nothing(image: StereoImage, near: float, far: float) -> Measurement:
    """Space planes for a photograph without stereo, between depths in units of the image."""
    planes = np.linspace(1 / far, 1 / near, MAX_PLANES, dtype=np.float32)
    none = np.zeros(image.size, np.float32)
    return Measurement(planes, none, none, none)
