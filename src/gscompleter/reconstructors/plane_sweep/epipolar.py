"""Correction of small rotation errors in the given poses.

A pose error of one pixel puts a match beside its epipolar line; a small rotation of one camera
moves the lines back onto the feature matches. Motion along a line cannot be separated from depth,
so it is kept small, and depths keep the scale of the given poses.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float

from gscompleter.reconstructors.features.sift import Pixels
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
)

MIN_MATCHES = 20
"""Fewest matches for a correction; with fewer the pose is kept."""
MAX_DISTANCE = 8.0
"""Largest distance of a valid match from its epipolar line, in pixels."""
ITERATIONS = 20
"""Iterations of reweighted least squares, which suppresses false matches."""


def rotate_to_matches(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> StereoImage:
    """Rotate `source` about its centre so that matches lie on their epipolar lines."""
    if len(pixels) == 0:
        return source
    distance, normal = compute_epipolar_distances(reference, source, pixels, matched)
    near = np.abs(distance) < MAX_DISTANCE
    if near.sum() < MIN_MATCHES:
        return source
    distance, normal = distance[near], normal[near]
    motion = compute_rotation_motion(source, matched[near])
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


def compute_epipolar_distances(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
    """Compute signed distances from the epipolar lines, in pixels, and the line normals."""
    transform = compute_source_from_reference(reference, source).astype(np.float64)
    ones = np.ones((len(pixels), 1))
    at_infinity = np.concatenate([pixels, ones], axis=1) @ transform[:, :3].T
    lines = np.cross(at_infinity, transform[:, 3])
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return (lines * np.concatenate([matched, ones], axis=1)).sum(axis=1), lines[:, :2]


def compute_rotation_motion(view: StereoImage, pixels: Pixels) -> Float[np.ndarray, "m 2 3"]:
    """Compute the pixel motion per radian of rotation about each camera axis."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(view.K).T
    turned = np.cross(np.eye(3)[None], rays[:, None])
    motion = turned[..., :2] - rays[:, None, :2] * turned[..., 2:]
    return (motion @ view.K[:2, :2].T).transpose(0, 2, 1)
