"""Pairs of cameras: those that may see the same, and distances of matches from epipolar lines."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

TURN_PER_STEP = 7.5
"""Angle in degrees between viewing directions that counts as much as a step between cameras. It is
chosen, not measured: it decides only which pairs are matched."""
MAX_CENTER_ROUNDING = 1e-6
"""Distance of cameras in one place at most, as a share of the largest distance between two cameras:
rounding moves centres."""
ERROR_SIDE = 256
"""Shorter side, in pixels, of the image that distances of matches from epipolar lines are given in:
of photographs of any size they can then be compared."""

Rays = Float[np.ndarray, "m 3"]
"""Directions in camera axes at z = 1."""
Focals = Float[np.ndarray, "2"]
"""Focal lengths along x and y, in pixels."""


def find_near_pairs(
    centers: Float[np.ndarray, "n 3"], forward: Float[np.ndarray, "n 3"], count: int
) -> list[tuple[int, int]]:
    """Pair each camera with the `count` most similar in place and direction; i < j, sorted.

    `centers` are in any unit, and `forward` are unit vectors along which cameras look. Rotations
    about these do not count, since features are matched in spite of them. There has to be a camera.
    """
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    turned = np.degrees(np.arccos((forward @ forward.T).clip(-1, 1)))
    # Cameras in one place, each with itself among them, form no pair: there is no parallax.
    distance[distance <= MAX_CENTER_ROUNDING * distance.max()] = np.inf
    # The usual distance between neighbouring cameras is the unit of the dissimilarity.
    step = np.median(distance.min(axis=1))
    if np.isinf(step):
        return []
    unlike = distance / step + turned / TURN_PER_STEP
    nearest = unlike.argsort(axis=1, kind="stable")[:, :count]
    pairs = {(i, int(j)) for i, row in enumerate(nearest) for j in row if np.isfinite(unlike[i, j])}
    return sorted({(min(pair), max(pair)) for pair in pairs})


def compute_sampson_distances(
    rotation: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, "3"],
    rays: tuple[Rays, Rays],
    focals: tuple[Focals, Focals],
) -> Float[np.ndarray, "m"]:
    """Compute signed Sampson distances of matches from their epipolar lines, in pixels.

    To first order, it is how far both features of a match together have to move until their rays
    meet. `rays` and `focals` are those of the first and the second camera. `rotation` and `shift`
    map points of the first camera to the second, in camera axes; the length of the shift does not
    matter, but without any all distances are 0.
    """
    x, y, z = shift
    # E = [t]x R, and b' E a = 0 for the rays a and b of one point.
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    a, b = rays
    line_in_b = a @ essential.T
    line_in_a = b @ essential
    # Gradient of the residual by the pixels of both features: a ray moves by 1 / focal per pixel.
    gradients = np.concatenate([line_in_b[:, :2] / focals[1], line_in_a[:, :2] / focals[0]], axis=1)
    residuals: Float[np.ndarray, "m"] = (b * line_in_b).sum(axis=1)
    return residuals / np.maximum(np.linalg.norm(gradients, axis=1), 1e-30)
