"""Small errors of the poses, as far as stereo suffers from them.

A match is looked for on its epipolar line. Where poses are off by a pixel it lies beside the line,
and what is found on it is something else. A small rotation of one camera brings the lines back to
the matches. Only the motion across the lines can be told: along them, an error of the pose looks
like another depth. The rotation is therefore the one that moves pixels along their lines as little
as possible, and depths keep the scale that the given poses imply.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float

from gscompleter.matching.features import Pixels
from gscompleter.matching.stereo_image import StereoImage, source_from_reference

MIN_MATCHES = 20
"""Fewest matches that tell a rotation; with fewer the poses stay as they are."""
MAX_DISTANCE = 8.0
"""Pixels beside its line beyond which a match is none."""
ITERATIONS = 20
"""Of reweighting, which makes false matches harmless."""


def rotated_to_matches(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> StereoImage:
    """`source`, rotated about its centre so that `matched` lie on the lines of `pixels`.

    Args:
        reference, source: The two views.
        pixels: Features of `reference` [m, 2].
        matched: The same features in `source` [m, 2].
    """
    if len(pixels) == 0:
        return source
    distance, normal = distances(reference, source, pixels, matched)
    near = np.abs(distance) < MAX_DISTANCE
    if near.sum() < MIN_MATCHES:
        return source
    distance, normal = distance[near], normal[near]
    motion = motion_by_rotation(source, matched[near])
    beside = (normal[:, :, None] * motion).sum(axis=1)
    along = normal[:, 0, None] * motion[:, 1] - normal[:, 1, None] * motion[:, 0]
    turn = np.zeros(3)
    for _ in range(ITERATIONS):
        miss = distance - beside @ turn
        spread = max(1.4826 * float(np.median(np.abs(miss))), 0.05)
        weight = 1 / (1 + (miss / spread) ** 2)
        cost = (beside.T * weight) @ beside
        # A squared motion along the lines costs as much as a squared distance from them.
        cost += weight.mean() * (along.T @ along)
        cost += 1e-9 * np.trace(cost) * np.eye(3)
        turn = np.linalg.solve(cost, (beside.T * weight) @ distance)
    rotation, _ = cv2.Rodrigues(turn)
    return replace(source, rotation=source.rotation @ rotation.T)


def distances(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
    """How far `matched` lie beside their epipolar lines, in pixels, and the lines' normals."""
    transform = source_from_reference(reference, source).astype(np.float64)
    ones = np.ones((len(pixels), 1))
    at_infinity = np.concatenate([pixels, ones], axis=1) @ transform[:, :3].T
    lines = np.cross(at_infinity, transform[:, 3])
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return (lines * np.concatenate([matched, ones], axis=1)).sum(axis=1), lines[:, :2]


def motion_by_rotation(view: StereoImage, pixels: Pixels) -> Float[np.ndarray, "m 2 3"]:
    """How `pixels` move when rays turn about the camera's three axes, in pixels per radian."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(view.K).T
    turned = np.cross(np.eye(3)[None], rays[:, None])
    slopes = turned[..., :2] - rays[:, None, :2] * turned[..., 2:]
    return (slopes @ view.K[:2, :2].T).transpose(0, 2, 1)
