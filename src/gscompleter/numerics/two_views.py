"""Pairs of photographs: which ones show the same, and how far matches lie from epipolar lines."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

TURN_PER_TWO_STEPS = 15.0
"""Rotation in degrees that counts as much as two steps between cameras."""
ERROR_SIDE = 256
"""Shorter side in pixels of the image in whose pixels distances of matches are told."""

Rays = Float[np.ndarray, "m 3"]
"""Directions in camera axes at z = 1."""
Focals = Float[np.ndarray, "2"]
"""Focal lengths along x and y, in pixels."""


def find_near_pairs(
    centers: Float[np.ndarray, "n 3"], forward: Float[np.ndarray, "n 3"], count: int
) -> list[tuple[int, int]]:
    """Find pairs i < j with a baseline, of each camera with `count` of similar place and direction.

    `forward` are unit vectors along which cameras look.
    """
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    turned = np.degrees(np.arccos((forward @ forward.T).clip(-1, 1)))
    # Cameras in one place, the same one among them, form no pair: there is no parallax.
    distance[distance == 0] = np.inf
    # The usual distance between neighbouring cameras is the unit of the dissimilarity.
    step = np.median(distance.min(axis=1))
    unlike = distance / step + 2 * turned / TURN_PER_TWO_STEPS
    nearest = unlike.argsort(axis=1, kind="stable")[:, :count]
    pairs = {(i, int(j)) for i, row in enumerate(nearest) for j in row if np.isfinite(unlike[i, j])}
    return sorted({(min(pair), max(pair)) for pair in pairs})


def compute_sampson_distances(
    rotation: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, "3"],
    rays: tuple[Rays, Rays],
    focals: tuple[Focals, Focals],
) -> Float[np.ndarray, "m"]:
    """Compute Sampson's distances of matches from their epipolar lines in pixels, with a sign.

    To first order, it is how far both features of a match together have to move to meet. `rotation`
    and `shift` lead points from the first camera to the second; the length of the shift does not
    matter.
    """
    x, y, z = shift
    # E = [t]x R, and b' E a = 0 for the rays a and b of one point.
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    a, b = rays
    line_in_b = a @ essential.T
    line_in_a = b @ essential
    # Slopes of the residual per pixel, not per unit of the image plane.
    slopes = np.concatenate([line_in_b[:, :2] / focals[1], line_in_a[:, :2] / focals[0]], axis=1)
    residuals: Float[np.ndarray, "m"] = (b * line_in_b).sum(axis=1)
    return residuals / np.maximum(np.linalg.norm(slopes, axis=1), 1e-30)
