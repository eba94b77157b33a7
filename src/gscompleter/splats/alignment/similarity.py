"""Similarities `x' = s R x + t` as 4x4 matrices, and cameras transformed by them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.types import Camera, View

Matrix = Float[np.ndarray, "4 4"]
"""A similarity or a pose, in float64."""


def make_similarity(
    scale: float, rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]
) -> Matrix:
    """Make the matrix of `x' = scale * rotation @ x + shift`."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = shift
    return matrix


def get_scale(transform: Matrix) -> float:
    """Get the scale of a similarity."""
    return float(np.cbrt(np.linalg.det(transform[:3, :3])))


def transform_pose(c2w: Matrix, transform: Matrix) -> Matrix:
    """Transform a camera-to-world pose by a similarity."""
    pose = np.eye(4)
    pose[:3, :3] = (transform[:3, :3] / get_scale(transform)) @ c2w[:3, :3]
    pose[:3, 3] = transform[:3, :3] @ c2w[:3, 3] + transform[:3, 3]
    return pose


def transform_camera(camera: Camera, transform: Matrix) -> Camera:
    """Transform a camera and its depth range; the identity returns the same object."""
    if np.array_equal(transform, np.eye(4)):
        return camera
    factor = get_scale(transform)
    c2w = torch.from_numpy(transform_pose(get_camera_pose(camera), transform)).to(camera.c2w)
    near = None if camera.near is None else camera.near * factor
    far = None if camera.far is None else camera.far * factor
    return replace(camera, c2w=c2w, near=near, far=far)


def transform_camera_exactly(camera: Camera, transform: Matrix) -> Camera:
    """Transform a camera in float64, for files: maps have large coordinates."""
    exact = replace(camera, c2w=camera.c2w.double(), K=camera.K.double())
    return transform_camera(exact, transform)


def transform_view(view: View, transform: Matrix) -> View:
    """Transform a photograph's camera and its depths."""
    if np.array_equal(transform, np.eye(4)):
        return view
    scale = get_scale(transform)
    return replace(
        view,
        camera=transform_camera(view.camera, transform),
        depth=None if view.depth is None else view.depth * scale,
        given_depth=None if view.given_depth is None else view.given_depth * scale,
    )


def get_camera_pose(camera: Camera) -> Matrix:
    """Get the camera-to-world transform as a float64 array."""
    return camera.c2w.detach().cpu().double().numpy()


def has_baseline(poses: Sequence[Matrix]) -> bool:
    """Return True if there are two or more cameras, at different positions."""
    centers = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
    return len(poses) >= 2 and bool(np.ptp(centers, axis=0).max() > 1e-6 * np.abs(centers).max())


def fit_pose_similarity(before: Sequence[Matrix], after: Sequence[Matrix]) -> Matrix:
    """Fit the similarity that moves poses to others of the same cameras, robust to outliers.

    It is such that `transform_pose(before[i], similarity)` is near `after[i]`. The rotation is the
    one closest to most, scale and shift are medians; both sets `has_baseline`. Least squares
    (`fit_center_similarity`, `move_to_given_frame`) would follow the poses that were found in a
    wrong place of a splat.
    """
    pairs = zip(before, after, strict=True)
    turns = np.stack([new[:3, :3] @ old[:3, :3].T for old, new in pairs])
    # trace(R_iᵀ R_j) grows as the angle between two rotations falls; each pair of poses gives one
    # rotation, and the one with the largest median trace is the closest to most.
    closeness = np.einsum("iab,jab->ij", turns, turns)
    rotation = turns[np.median(closeness, axis=1).argmax()]
    starts = np.stack(before)[:, :3, 3]
    ends = np.stack(after)[:, :3, 3]
    # Scale: the median over cameras of the median ratio of its distances to the others, since pairs
    # with a camera that is an outlier are wrong altogether.
    apart = np.linalg.norm(starts[:, None] - starts, axis=-1)
    # Every camera is far enough from at least one of the two that are farthest apart.
    apart[apart < 0.3 * apart.max()] = np.nan
    ratios = np.linalg.norm(ends[:, None] - ends, axis=-1) / apart
    scale = float(np.median(np.nanmedian(ratios, axis=1)))
    shift = np.median(ends - scale * starts @ rotation.T, axis=0)
    return make_similarity(scale, rotation, shift)
