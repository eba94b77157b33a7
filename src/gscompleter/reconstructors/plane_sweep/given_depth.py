"""Depth that is given with a photograph, as a measurement instead of stereo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.sweep import (
    MAX_PLANES,
    Measurement,
    compute_plane_index,
)


def add_given(measured: Measurement, image: StereoImage) -> Measurement:
    """Use given depths instead of stereo, with the weight of the most confident stereo."""
    full = measured.resize_to(image.size)
    known = image.given > 0
    sure = np.float32(1)
    # Given depths outside the searched range lie one plane beyond it.
    index = compute_plane_index(full.planes, image.given).clip(-1, len(full.planes))
    return replace(
        full,
        index=np.where(known, index, full.index),
        weight=np.where(known, sure, full.weight),
        confidence=np.where(known, sure, full.confidence),
    )


def measure_nothing(image: StereoImage, near: float, far: float) -> Measurement:
    """Space planes for a photograph without stereo, between depths in units of the image."""
    planes = np.linspace(1 / far, 1 / near, MAX_PLANES, dtype=np.float32)
    none = np.zeros(image.size, np.float32)
    return Measurement(planes, none, none, none)
