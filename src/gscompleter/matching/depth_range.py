"""How near and how far the scene lies, from matched features alone."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from gscompleter.matching.features import features_of, matches
from gscompleter.matching.frames import Frame, frames_of, transform_between
from gscompleter.types import View

MIN_MATCHES = 12
"""Fewest triangulated features that tell a depth range."""
MAX_PAIRS = 12
"""Most pairs of views whose features are matched."""


def estimate_depth_range(views: Sequence[View]) -> tuple[float, float]:
    """Near and far z-depth, in scene units, that enclose what the views see.

    Features are matched between pairs, checked against the known poses and triangulated; half of
    the nearest and four times the farthest percentile leave room for what carries no feature.
    With too few matches the baseline sets the range: from where it moves a pixel by a fifth of
    the image, to where it moves it by a third of a pixel.

    Raises:
        InputError: with fewer than two views, or where all of them stand in one place.
    """
    frames, unit = frames_of(views)
    inverse = triangulated(frames)
    if len(inverse) < MIN_MATCHES:
        near, far = range_from_baseline(frames)
    else:
        low, high = np.quantile(inverse, [0.02, 0.98])
        near, far = 0.5 / high, 4.0 / low
    return near * unit, far * unit


def range_from_baseline(frames: Sequence[Frame]) -> tuple[float, float]:
    """Depths (in baselines) at which the widest baseline still, and just no longer, matches."""
    focal = float(np.median([frame.K[0, 0] for frame in frames]))
    width = float(np.median([frame.size[1] for frame in frames]))
    return focal / (0.4 * width), 3.0 * focal


def triangulated(frames: Sequence[Frame]) -> Float[np.ndarray, "n"]:
    """Inverse z-depths (per baseline) of features that agree with the epipolar geometry."""
    features = [features_of(frame) for frame in frames]
    pairs = sorted(
        combinations(range(len(frames)), 2),
        key=lambda p: -float(np.linalg.norm(frames[p[0]].center - frames[p[1]].center)),
    )
    found = [np.zeros(0)]
    for i, j in pairs[:MAX_PAIRS]:
        a, b = matches(features[i], features[j])
        if len(a):
            found.append(_inverse_depths(frames[i], frames[j], a, b))
            found.append(_inverse_depths(frames[j], frames[i], b, a))
    return np.concatenate(found)


def _inverse_depths(
    reference: Frame,
    source: Frame,
    pixels: Float[np.ndarray, "n 2"],
    matched: Float[np.ndarray, "n 2"],
    max_error: float = 3.0,
    min_parallax: float = 1.0,
) -> Float[np.ndarray, "m"]:
    """Inverse z-depths in `reference` of the matches that lie on their epipolar lines.

    A match that hardly moves tells nothing of depth, so that it takes a parallax of
    `min_parallax` pixels; errors of `max_error` pixels off the line leave room for noisy poses.
    """
    transform = transform_between(reference, source).astype(np.float64)
    at_infinity = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ transform[:, :3].T
    b = transform[:, 3]
    # Least squares of matched * (A p + b w)_2 = (A p + b w)_xy in w.
    slope = b[:2] - matched * b[2]
    offset = matched * at_infinity[:, 2:] - at_infinity[:, :2]
    inverse = (slope * offset).sum(1) / np.maximum((slope * slope).sum(1), 1e-12)
    there = at_infinity + inverse[:, None] * b
    ahead = (there[:, 2] > 1e-6) & (at_infinity[:, 2] > 1e-6)
    scale = np.where(ahead, there[:, 2], 1.0)[:, None]
    error = np.linalg.norm(there[:, :2] / scale - matched, axis=1)
    start = at_infinity[:, :2] / np.where(ahead, at_infinity[:, 2], 1.0)[:, None]
    parallax = np.linalg.norm(start - matched, axis=1)
    return inverse[ahead & (inverse > 0) & (error < max_error) & (parallax > min_parallax)]
