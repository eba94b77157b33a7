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
"""Fewest matches by which the pose of a photograph is judged. A pair of photographs with fewer does
not count at all: without a common surface two have up to 25 false ones."""


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

    Pixels are those of the photograph itself, at the working size of its view. The error is the
    median distance of the features that a photograph shares with those around it from where the
    poses put them, so that the error of a single photograph also shows at its neighbours.
    Localization of the features alone gives 0.1 to 0.3 pixels.
    """
    if not has_distinct_centers(views):
        return [None] * len(views)
    images, _ = make_stereo_images(views)
    errors: list[list[Float[np.ndarray, "k"]]] = [[] for _ in images]
    for (i, j), (in_i, in_j) in find_neighbours(images).matches.items():
        if len(in_i) < MIN_POSE_MATCHES:
            continue
        # In pixels of photograph j.
        distances, is_ahead = measure_match_errors(images[i], images[j], in_i, in_j)
        is_true = choose_true_matches(in_i, in_j, distances, is_ahead)
        distances = np.where(is_ahead, distances, np.inf)[is_true]
        for number in (i, j):
            own = distances * compare_focal_lengths(images[number], images[j])
            # No pose is off by more than an image, also where it puts a match behind the camera.
            errors[number].append(own.clip(max=max(images[number].size)))
    joined = [np.concatenate([np.zeros(0), *parts]) for parts in errors]
    return [float(np.median(e)) if len(e) >= MIN_POSE_MATCHES else None for e in joined]


def compare_focal_lengths(image: StereoImage, other: StereoImage) -> float:
    """Return the focal length of an image over that of another, each the mean of both axes.

    So many pixels of the one are as wide as a pixel of the other.
    """
    own, others = (np.sqrt(each.K[0, 0] * each.K[1, 1]) for each in (image, other))
    return float(own / others)


def find_true_matches(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> Bool[np.ndarray, "n"]:
    """Find the matches of two photographs that are not false, as `choose_true_matches` does."""
    errors, is_ahead = measure_match_errors(reference, source, pixels, matched)
    return choose_true_matches(pixels, matched, errors, is_ahead)


def choose_true_matches(
    pixels: Pixels,
    matched: Pixels,
    errors: Float[np.ndarray, "n"],
    is_ahead: Bool[np.ndarray, "n"],
) -> Bool[np.ndarray, "n"]:
    """Choose the matches of two photographs that are not false.

    A match lies far off because it is false, or because a pose is wrong, so the poses alone do not
    decide: if another epipolar geometry explains most matches, and poses confirm less than half of
    these, they are true. `errors` and `is_ahead` are those of `measure_match_errors`.
    """
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
