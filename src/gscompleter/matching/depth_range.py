"""How near and how far the scene lies, from matched features alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from gscompleter.errors import InputError
from gscompleter.matching.features import Pixels, features_of, matches
from gscompleter.matching.stereo_image import StereoImage, source_from_reference, stereo_images
from gscompleter.types import View

MIN_MATCHES = 12
"""Fewest triangulated features that tell a depth range."""
MAX_PAIRS = 12
"""Most pairs of views whose features are matched."""
MAX_ERROR = 3.0
"""Pixels that a match may lie off its epipolar line: poses are noisy."""
MIN_PARALLAX = 1.0
"""Pixels that a match must move to tell a depth."""


def estimate_depth_range(views: Sequence[View]) -> tuple[float, float]:
    """Near and far z-depth, in scene units, that enclose what the views see.

    Features are matched between pairs, checked against the known poses and triangulated; half of
    the nearest and four times the farthest percentile leave room for what carries no feature.
    With too few matches the baseline sets the range: from where it moves a pixel by a fifth of
    the image, to where it moves it by a third of a pixel.

    Raises:
        InputError: with fewer than two views, or where all of them stand in one place.
    """
    images, unit = stereo_images(views)
    inverse = triangulated(images)
    if len(inverse) < MIN_MATCHES:
        near, far = range_from_baseline(images)
    else:
        low, high = np.quantile(inverse, [0.02, 0.98])
        near, far = 0.5 / high, 4.0 / low
    return near * unit, far * unit


def depth_range_of(
    views: Sequence[View],
    estimate: Callable[[Sequence[View]], tuple[float, float]] = estimate_depth_range,
) -> tuple[float, float]:
    """Near and far z-depth, in scene units: as the first camera knows them, else estimated.

    Args:
        views: Photographs of one scene.
        estimate: Finds what the camera does not know; as it stands, from matched features.

    Raises:
        InputError: where the range is empty.
    """
    near, far = views[0].camera.near, views[0].camera.far
    if near is None or far is None:
        low, high = estimate(views)
        near, far = near if near is not None else low, far if far is not None else high
    if not 0 < near < far:
        raise InputError(
            f"The depth range {near:g} to {far:g} is empty; near must be positive and less "
            "than far."
        )
    return near, far


def range_from_baseline(images: Sequence[StereoImage]) -> tuple[float, float]:
    """Depths (in baselines) at which the widest baseline still, and just no longer, matches."""
    focal = float(np.median([image.K[0, 0] for image in images]))
    width = float(np.median([image.size[1] for image in images]))
    return focal / (0.4 * width), 3.0 * focal


def triangulated(images: Sequence[StereoImage]) -> Float[np.ndarray, "n"]:
    """Inverse z-depths (per baseline) of features that agree with the epipolar geometry."""
    features = [features_of(image) for image in images]
    pairs = sorted(
        combinations(range(len(images)), 2),
        key=lambda p: -float(np.linalg.norm(images[p[0]].center - images[p[1]].center)),
    )
    found = [np.zeros(0)]
    for i, j in pairs[:MAX_PAIRS]:
        a, b = matches(features[i], features[j])
        if len(a):
            found.append(inverse_depths(images[i], images[j], a, b))
            found.append(inverse_depths(images[j], images[i], b, a))
    return np.concatenate(found)


def inverse_depths(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> Float[np.ndarray, "k"]:
    """Inverse z-depths in `reference` of the matches that lie on their epipolar lines.

    A match that hardly moves tells nothing of depth.
    """
    transform = source_from_reference(reference, source).astype(np.float64)
    at_infinity = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ transform[:, :3].T
    b = transform[:, 3]
    # Least squares of matched * (A p + b w)_2 = (A p + b w)_xy in w.
    slope = b[:2] - matched * b[2]
    offset = matched * at_infinity[:, 2:] - at_infinity[:, :2]
    inverse = (slope * offset).sum(1) / np.maximum((slope * slope).sum(1), 1e-12)
    at_depth = at_infinity + inverse[:, None] * b
    ahead = (at_depth[:, 2] > 1e-6) & (at_infinity[:, 2] > 1e-6)
    scale = np.where(ahead, at_depth[:, 2], 1.0)[:, None]
    error = np.linalg.norm(at_depth[:, :2] / scale - matched, axis=1)
    start = at_infinity[:, :2] / np.where(ahead, at_infinity[:, 2], 1.0)[:, None]
    parallax = np.linalg.norm(start - matched, axis=1)
    return inverse[ahead & (inverse > 0) & (error < MAX_ERROR) & (parallax > MIN_PARALLAX)]
