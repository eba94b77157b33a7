"""How well poses agree with matches, beside the best poses that the matches allow.

The relative pose of two photographs puts each match on a line of the other photograph (its epipolar
line). Localization of the features alone leaves some tenths of a pixel, so the distance under the
given pose says little; it contradicts the pose if another pose has a much smaller one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from gscompleter.numerics.two_views import ERROR_SIDE, Focals, Rays, compute_sampson_distances
from gscompleter.reconstructors.features.consistency import MIN_POSE_MATCHES, find_true_matches
from gscompleter.reconstructors.features.matches import Pixels
from gscompleter.reconstructors.features.neighbours import find_neighbours
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    has_distinct_centers,
    make_stereo_images,
)
from gscompleter.types import View

MIN_CONTRADICTION = 0.12
"""Smallest median distance under given poses that matters. Poses from structure from motion have
0.03 to 0.16 px, before and after they are fitted; those of SLAM and drives 0.15 to 1.2 px."""
MAX_FITTED_SHARE = 0.65
"""Largest share of that distance under fitted poses. It was 0.3 to 0.55 where poses are wrong, and
0.75 to 1 where they are right."""

STEP_SCALES = (1e-3, 1e-3, 1e-3, 1e-2, 1e-2)
"""Usual sizes of the steps of a fit, in radians: of the turn about three axes, and of the direction
of the shift across two. A turn of 1e-3 moves features by a third of a pixel at a focal length of
300 pixels. The direction takes ten times that to move them as much, where the shift is a tenth of
the depth."""

RelativePose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
"""Rotation and direction of the shift of points from a reference camera to a source camera."""


@dataclass(frozen=True)
class PoseFit:
    """Median distances of matches from their epipolar lines, in pixels.

    They are those of images whose shorter side is `ERROR_SIDE`: each pair is scaled by the smaller
    of its photographs.
    """

    given: float
    """Under the given poses."""
    fitted: float
    """Under the relative pose of each pair that fits its matches best; as `given` where that is
    at most `MIN_CONTRADICTION`."""

    @property
    def is_contradicted(self) -> bool:
        """True if matches contradict the given poses."""
        return self.given > MIN_CONTRADICTION and self.fitted < MAX_FITTED_SHARE * self.given


def measure_pose_fit(views: Sequence[View]) -> PoseFit | None:
    """Measure how well the poses of views agree with matches; None with too few of these.

    Each pair whose features `find_neighbours` matched, that is of cameras similar in place and
    direction, is fitted alone: it tells that poses are wrong, but not which.
    """
    if len(views) < 2 or not has_distinct_centers(views):
        return None
    images, _ = make_stereo_images(views)
    given = []
    pairs = []
    for (i, j), (in_i, in_j) in find_neighbours(images).matches.items():
        reference, source = images[i], images[j]
        is_true = find_true_matches(reference, source, in_i, in_j)
        if is_true.sum() < MIN_POSE_MATCHES:
            continue
        rays = (make_rays(reference, in_i[is_true]), make_rays(source, in_j[is_true]))
        focals = (reference.K.diagonal()[:2], source.K.diagonal()[:2])
        pose = compute_relative_pose(reference, source)
        # Sampson distances mix pixels of both photographs. The smaller one limits how well features
        # can be located, so that its pixels are counted.
        scale = ERROR_SIDE / min(*reference.size, *source.size)
        given.append(np.abs(compute_sampson_distances(*pose, rays, focals)) * scale)
        pairs.append((pose, rays, focals, scale))
    if not given:
        return None
    before = float(np.median(np.concatenate(given)))
    # Poses that agree as well as features can be located need no fit.
    if before <= MIN_CONTRADICTION:
        return PoseFit(before, before)
    fitted = []
    for pose, rays, focals, scale in pairs:
        best = fit_relative_pose(pose, rays, focals)
        fitted.append(np.abs(compute_sampson_distances(*best, rays, focals)) * scale)
    return PoseFit(before, float(np.median(np.concatenate(fitted))))


def make_rays(image: StereoImage, pixels: Pixels) -> Rays:
    """Make the rays of pixels, in camera axes at z = 1."""
    whole = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    return whole @ np.linalg.inv(image.K).T


def compute_relative_pose(reference: StereoImage, source: StereoImage) -> RelativePose:
    """Compute the rotation, and the direction of the shift, from reference to source.

    The cameras have to be in different places, as those of matched pairs are.
    """
    # A point x of the world is Rᵀ (x - c) in a camera with rotation R to world axes and centre c.
    shift = source.rotation.T @ (reference.center - source.center)
    return source.rotation.T @ reference.rotation, shift / np.linalg.norm(shift)


def fit_relative_pose(
    start: RelativePose,
    rays: tuple[Rays, Rays],
    focals: tuple[Focals, Focals],
) -> RelativePose:
    """Fit the relative pose with the smallest Sampson distances, by robust least squares.

    Distances are in pixels of the photographs, as `focals` are, and above one they count less.
    """
    # Imported here, as most poses need no fit.
    from scipy.optimize import least_squares

    # Two directions across the shift, the rows that complete it to an orthonormal basis: matches do
    # not tell its length.
    across = np.linalg.svd(start[1][None])[2][1:]

    def change(step: Float[np.ndarray, "5"]) -> RelativePose:
        # A rotation vector in camera axes of the source, then the parts across the shift.
        turn: Float[np.ndarray, "3 3"] = cv2.Rodrigues(step[:3])[0]
        shift = start[1] + step[3:] @ across
        return turn @ start[0], shift / np.linalg.norm(shift)

    solution = least_squares(
        lambda step: compute_sampson_distances(*change(step), rays, focals),
        np.zeros(5),
        loss="soft_l1",
        x_scale=STEP_SCALES,
    )
    return change(solution.x)
