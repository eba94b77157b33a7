"""Alignment of two sets of camera centres by a similarity (Umeyama 1991), with RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gscompleter.system.errors import InputError

Points = Float[np.ndarray, "n 3"]

MIN_RANSAC_CAMERAS = 10
"""Smallest number of cameras for which RANSAC rejects outliers."""
NUM_RANSAC_SAMPLES = 10
"""Number of random samples, each of half of the cameras."""
RANSAC_SEED = 42
"""Seed of the samples, as in the authors' code."""


@dataclass(frozen=True)
class Similarity:
    """The transform `x' = scale * rotation @ x + shift`."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def __call__(self, points: Points) -> Points:
        """Transform points."""
        return self.scale * points @ self.rotation.T + self.shift


def fit_center_similarity(source: Points, destination: Points) -> Similarity:
    """Fit the similarity from `source` to `destination` by least squares.

    The destination is what a model predicts.

    Raises:
        InputError: All points of one side are equal, or the model predicts none.
    """
    # Umeyama's closed form: centre both sets, and take the singular values of their covariance.
    x = source.astype(np.float64)
    y = destination.astype(np.float64)
    middle_x = x.mean(0)
    middle_y = y.mean(0)
    x = x - middle_x
    y = y - middle_y
    spread = (x**2).sum(1).mean()
    if not spread > 0:
        raise InputError(
            f"All {len(x)} cameras stand in one place, so the scale is unknown; give photographs "
            "taken from different positions."
        )
    predicted_spread = (y**2).sum(1).mean()
    # NaN is not above 0 either.
    if not 0 < predicted_spread < np.inf:
        raise InputError(
            f"The model tells no distances between the {len(y)} cameras, so the scale of its "
            "depths is unknown; give photographs taken from farther apart."
        )
    u, values, v = np.linalg.svd(y.T @ x / len(x))
    # The sign keeps the rotation from becoming a reflection.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(v))])
    rotation = (u * signs) @ v
    scale = float((values * signs).sum() / spread)
    return Similarity(scale, rotation, middle_y - scale * rotation @ middle_x)


def fit_robust_similarity(source: Points, destination: Points) -> Similarity:
    """Fit a similarity, with RANSAC from ten points on.

    It follows the authors' code to its samples, so that their results are met; the fits of our own
    (`fit_pose_similarity`, `move_to_given_frame`) also use the rotations of the cameras. Errors as
    in `fit_center_similarity`.
    """
    every = fit_center_similarity(source, destination)
    if len(source) < MIN_RANSAC_CAMERAS:
        return every
    # After the fit to all, the median distance to the nearest centre: what is farther from its own
    # counterpart in the fit to a half is an outlier.
    distances = np.linalg.norm(every(source)[:, None] - destination, axis=-1)
    threshold = float(np.median(distances.min(axis=1)))
    generator = np.random.default_rng(RANSAC_SEED)
    size = max(3, (len(source) + 1) // 2)
    halves = [generator.choice(len(source), size, replace=False) for _ in range(NUM_RANSAC_SAMPLES)]

    best = None
    least = (0, np.inf)
    for half in halves:
        try:
            fit = fit_center_similarity(source[half], destination[half])
        except InputError:  # cameras in one place determine no scale
            continue
        error = np.linalg.norm(fit(source) - destination, axis=1)
        inliers = error <= threshold
        count = int(inliers.sum())
        mean = float(error[inliers].mean()) if count else np.inf
        # More inliers win, and of equally many those with the smaller mean error.
        if (count, -mean) > (least[0], -least[1]):
            best = inliers
            least = (count, mean)
    if best is None or least[0] < 3:
        return every
    return fit_center_similarity(source[best], destination[best])
