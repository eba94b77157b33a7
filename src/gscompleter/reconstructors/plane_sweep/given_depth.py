"""Depth that is given with a photograph, as a measurement instead of stereo.

A sensor is truer than stereo, whose level errors of the poses shift: with the right depth of
hololens_room its photographs 0 and 3 are reproduced 5 dB worse, and the target 5 dB better. So it
is refused only if the shape of its surfaces clearly contradicts stereo, as that of a network does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.hidden_blocks import compare_in_hidden_blocks
from gscompleter.reconstructors.plane_sweep.sweep import (
    MAX_PLANES,
    Measurement,
    compute_plane_index,
)

MIN_TESTED_SHARE = 0.1
"""Smallest share of the pixels with given depth that is tested: fewer are points that were
triangulated from the photographs, or a laser's."""
MAX_GIVEN_RATIO = 1.2
"""Largest error in hidden blocks of stereo with the given depth, relative to that without it. In 16
photographs of three scenes it is at most 1.11 with the depth of the sensor, and at least 1.2 in 15
with that of a small network."""


def is_dense(image: StereoImage) -> bool:
    """Return True if the given depth of an image is dense enough for a test."""
    return float((image.given > 0).mean()) >= MIN_TESTED_SHARE


def contradicts_stereo(image: StereoImage, stereo: Measurement) -> bool:
    """Return True if given depth tells hidden blocks of stereo clearly worse than continuing them.

    `stereo` is measured without it.
    """
    if not is_dense(image):
        return False
    full = stereo.resize_to(image.size)
    # A pixel without a given depth has an inverse depth of 0.
    errors = compare_in_hidden_blocks(image.given, image.given > 0, full, image.image)
    # Where stereo measures too little, the given depth is believed.
    return errors is not None and errors.ratio > MAX_GIVEN_RATIO


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
    """Space planes for a photograph without stereo, with weight 0 everywhere.

    `near` and `far` are z-depths in the unit of lengths of the image, as `given` has it.
    """
    planes = np.linspace(1 / far, 1 / near, MAX_PLANES, dtype=np.float32)
    none = np.zeros(image.size, np.float32)
    return Measurement(planes, none, none, none)
