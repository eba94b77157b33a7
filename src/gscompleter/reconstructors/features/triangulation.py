"""Depth of matched features of two photographs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from gscompleter.reconstructors.features.sift import Pixels
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
)

MAX_ERROR = 3.0
"""Largest distance of a match from its epipolar line, in pixels; poses are noisy."""
MIN_PARALLAX = 1.0
"""Smallest parallax that gives a depth, in pixels."""


def triangulate_valid(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> Float[np.ndarray, "k"]:
    """Triangulate the valid matches; return inverse z-depth in `reference`."""
    inverse, good = triangulate(reference, source, pixels, matched)
    return inverse[good]


def triangulate(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Triangulate all matches; return inverse z-depth in `reference` and a validity mask."""
    transform = compute_source_from_reference(reference, source).astype(np.float64)
    at_infinity = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ transform[:, :3].T
    b = transform[:, 3]
    # Solve matched * (A p + b w)_2 = (A p + b w)_xy for w by least squares.
    factor = b[:2] - matched * b[2]
    offset = matched * at_infinity[:, 2:] - at_infinity[:, :2]
    inverse = (factor * offset).sum(1) / np.maximum((factor * factor).sum(1), 1e-12)
    at_depth = at_infinity + inverse[:, None] * b
    ahead = (at_depth[:, 2] > 1e-6) & (at_infinity[:, 2] > 1e-6)
    scale = np.where(ahead, at_depth[:, 2], 1.0)[:, None]
    error = np.linalg.norm(at_depth[:, :2] / scale - matched, axis=1)
    start = at_infinity[:, :2] / np.where(ahead, at_infinity[:, 2], 1.0)[:, None]
    parallax = np.linalg.norm(start - matched, axis=1)
    return inverse, ahead & (inverse > 0) & (error < MAX_ERROR) & (parallax > MIN_PARALLAX)
