"""Consistency of camera poses with the features that photographs share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from gscompleter.reconstructors.features.matches import MAX_ERROR, Pixels, triangulate
from gscompleter.reconstructors.features.neighbours import find_neighbours
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
    make_stereo_images,
)
from gscompleter.types import View

MIN_DEPTH = 1e-6
"""Smallest z in the source, per z in the reference, that lies in front of it."""


@dataclass(frozen=True)
class MatchCount:
    """Features that two photographs share, over all pairs of neighbours."""

    total: int
    consistent: int
    """Matches that one point in front of both cameras explains."""

    @property
    def share(self) -> float:
        """Share of the consistent matches; 0 without matches."""
        return self.consistent / max(self.total, 1)


def count_consistent_matches(views: Sequence[View]) -> MatchCount:
    """Count the features that two of several views share, and those that fit the poses.

    Matches are found without the poses, so that of wrong poses only few fit, by chance.
    """
    images, _ = make_stereo_images(views)
    total = consistent = 0
    for (i, j), (in_i, in_j) in find_neighbours(images).matches.items():
        if len(in_i) > 0:
            total += len(in_i)
            consistent += int(fit_poses(images[i], images[j], in_i, in_j).sum())
    return MatchCount(total, consistent)


def fit_poses(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> Bool[np.ndarray, "n"]:
    """Find matches that some point in front of both cameras explains up to `MAX_ERROR`, in pixels.

    Unlike `triangulate`, it accepts points at infinity: a match without parallax has no depth, but
    it confirms the rotation.
    """
    inverse, _ = triangulate(reference, source, pixels, matched)
    transform = compute_source_from_reference(reference, source).astype(np.float64)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ transform[:, :3].T
    # A negative inverse depth lies behind the camera; the nearest possible one is that of infinity.
    points = rays + np.maximum(inverse, 0)[:, None] * transform[:, 3]
    is_ahead = points[:, 2] > MIN_DEPTH
    depths = np.where(is_ahead, points[:, 2], 1.0)
    errors = np.linalg.norm(points[:, :2] / depths[:, None] - matched, axis=1)
    return is_ahead & (errors < MAX_ERROR)
