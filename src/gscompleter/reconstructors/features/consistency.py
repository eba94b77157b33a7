"""Consistency of camera poses with the features that photographs share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from gscompleter.reconstructors.features.matches import (
    MAX_EPIPOLAR_DISTANCE,
    Pixels,
    find_fitting_matches,
    measure_match_errors,
)
from gscompleter.reconstructors.features.neighbours import find_neighbours
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    has_distinct_centers,
    make_stereo_images,
)
from gscompleter.types import View

MAX_POSE_ERROR = 8.0
"""Largest error of a match that the poses confirm, in pixels of the working size of the photograph
that it is measured in."""
MIN_POSE_MATCHES = 30
"""Fewest matches by which the pose of a photograph is judged, and those of a pair that count:
photographs without a common surface have up to 25 false ones."""


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
            consistent += int(find_fitting_matches(images[i], images[j], in_i, in_j).sum())
    return MatchCount(total, consistent)


def measure_pose_errors(views: Sequence[View]) -> list[float | None]:
    """Measure by how many pixels the pose of each photograph is off, None if that is not known.

    Pixels are those of the views, at their working size. The error is the median distance of the
    features that a photograph shares with those around it from where the poses put them, so that
    the error of a single photograph also shows at its neighbours.
    Localization of the features alone gives 0.1 to 0.3 pixels.
    """
    if not has_distinct_centers(views):
        return [None] * len(views)
    images, _ = make_stereo_images(views)
    errors: list[list[Float[np.ndarray, "k"]]] = [[] for _ in images]
    for (i, j), (in_i, in_j) in find_neighbours(images).matches.items():
        if len(in_i) < MIN_POSE_MATCHES:
            continue
        is_true = find_true_matches(images[i], images[j], in_i, in_j)
        distances, is_ahead = measure_match_errors(images[i], images[j], in_i, in_j)
        # No pose is off by more than an image, also where it puts a match behind the camera.
        counted = np.where(is_ahead, distances, np.inf).clip(max=max(images[j].size))[is_true]
        errors[i].append(counted)
        errors[j].append(counted)
    joined = [np.concatenate([np.zeros(0), *parts]) for parts in errors]
    return [float(np.median(e)) if len(e) >= MIN_POSE_MATCHES else None for e in joined]


def find_true_matches(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> Bool[np.ndarray, "n"]:
    """Find the matches of two photographs that are not false.

    A match lies far off because it is false, or because a pose is wrong, so the poses alone do not
    decide: if another epipolar geometry explains most matches, and poses confirm less than half of
    these, they are true.
    """
    errors, is_ahead = measure_match_errors(reference, source, pixels, matched)
    is_near = is_ahead & (errors < MAX_POSE_ERROR)
    if len(pixels) < MIN_POSE_MATCHES:
        return is_near
    # RANSAC of OpenCV, whose samples are the same in each call; it may find no geometry at all.
    _, found = cv2.findFundamentalMat(pixels, matched, cv2.FM_RANSAC, MAX_EPIPOLAR_DISTANCE)
    is_explained = is_near if found is None else found.ravel() > 0
    is_clear = is_explained.sum() >= max(MIN_POSE_MATCHES, len(pixels) / 2)
    # A geometry without poses explains some false matches, too, by which a fit of poses gets worse.
    # So it counts only where poses miss most of what it explains.
    is_missed = (is_near & is_explained).sum() < is_explained.sum() / 2
    return is_explained if is_clear and is_missed else is_near
