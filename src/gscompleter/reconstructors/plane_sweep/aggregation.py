"""Semi-global aggregation of costs: neighbours of similar colour get similar depths."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int16, UInt8

from gscompleter.kernels import stereo
from gscompleter.kernels.stereo import Bands
from gscompleter.reconstructors.features.stereo_image import StereoImage, compute_contrast

SMALL_PENALTY = 25
"""Cost of a change by one plane between neighbouring pixels."""
LARGE_PENALTY = 300
"""Cost of a larger jump between neighbouring pixels of the same colour."""
EDGE_CONTRAST = 0.06
"""Colour difference at which the penalty of a jump is halved."""


def aggregate(
    costs: UInt8[np.ndarray, "cells"], bands: Bands, reference: StereoImage
) -> Int16[np.ndarray, "cells"]:
    """Sum the costs along eight paths through the image; jumps are cheap at image edges."""
    image = reference.image

    def jump(
        a: Float32[np.ndarray, "r c 3"], b: Float32[np.ndarray, "r c 3"]
    ) -> Int16[np.ndarray, "r c"]:
        penalty = LARGE_PENALTY / (1 + compute_contrast(a, b) / np.float32(EDGE_CONTRAST))
        return np.rint(np.maximum(penalty, 1.5 * SMALL_PENALTY)).astype(np.int16)

    return stereo.aggregate_semi_globally(
        costs,
        bands,
        jump(image[:, 1:], image[:, :-1]),
        jump(image[1:], image[:-1]),
        jump(image[1:, 1:], image[:-1, :-1]),
        jump(image[:-1, 1:], image[1:, :-1]),
        np.int16(SMALL_PENALTY),
    )
