"""The similarity between two sets of camera centres (Umeyama 1991), from most of them where there
are many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from gscompleter.errors import InputError

Points = Float[np.ndarray, "n 3"]

MANY = 10
"""Cameras from which on a minority of wrong ones is left out (RANSAC)."""
DRAWS = 10
"""Random halves of the cameras that are tried."""
SEED = 42
"""Of these draws, as the authors have it."""


@dataclass(frozen=True)
class Similarity:
    """`x' = scale * rotation @ x + shift`."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def __call__(self, points: Points) -> Points:
        return self.scale * points @ self.rotation.T + self.shift


def similarity_between(given: Points, found: Points) -> Similarity:
    """The one that leads from `given` to `found` with the least squared error.

    Of points on one line, as any two are, the turn about that line is arbitrary; the scale is not.

    Raises:
        InputError: where all of `given` are one point.
    """
    x, y = given.astype(np.float64), found.astype(np.float64)
    middle_x, middle_y = x.mean(0), y.mean(0)
    x, y = x - middle_x, y - middle_y
    spread = (x**2).sum(1).mean()
    if not spread > 0:
        raise InputError(
            f"All {len(x)} cameras stand in one place, which tells no scale; give photographs "
            "taken from different positions."
        )
    u, values, v = np.linalg.svd(y.T @ x / len(x))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(v))])
    rotation = (u * signs) @ v
    scale = float((values * signs).sum() / spread)
    return Similarity(scale, rotation, middle_y - scale * rotation @ middle_x)


def similarity_of_most(given: Points, found: Points) -> Similarity:
    """The same, of ten points and more from those that agree best with a random half of all.

    Raises:
        InputError: where all of `given` are one point.
    """
    every = similarity_between(given, found)
    if len(given) < MANY:
        return every
    threshold = float(np.median(distances_to_nearest(every(given), found)))
    best, least = None, (0, np.inf)
    for half in halves(len(given)):
        if np.ptp(given[half], axis=0).max() == 0:
            continue
        error = np.linalg.norm(similarity_between(given[half], found[half])(given) - found, axis=1)
        inliers = error <= threshold
        count = int(inliers.sum())
        mean = float(error[inliers].mean()) if count else np.inf
        if (count, -mean) > (least[0], -least[1]):
            best, least = inliers, (count, mean)
    if best is None or least[0] < 3:
        return every
    return similarity_between(given[best], found[best])


def halves(count: int) -> list[Int[np.ndarray, "_"]]:
    """Random choices of half of `count` points."""
    generator = np.random.default_rng(SEED)
    size = max(3, (count + 1) // 2)
    return [generator.choice(count, size, replace=False) for _ in range(DRAWS)]


def distances_to_nearest(points: Points, others: Points) -> Float[np.ndarray, "n"]:
    """How far each point lies from the nearest of the others."""
    return np.linalg.norm(points[:, None] - others, axis=-1).min(axis=1)
