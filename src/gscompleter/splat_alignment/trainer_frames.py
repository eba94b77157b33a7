"""Normalisations that splat trainers apply to a scene, computed from cameras and points.

Each function takes poses (OpenCV axes) and returns transforms from their frame to the trainer's.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from gscompleter.splat_alignment.similarity import Matrix, make_similarity, transform_pose

Poses = Float[np.ndarray, "n 4 4"]
Points = Float[np.ndarray, "p 3"]

NERFSTUDIO_WORLDS = (
    np.eye(3),
    np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
)
"""Rotations from COLMAP's world that nerfstudio applies first: none, today's, the former."""


def compute_trainer_frames(
    poses: Poses, points: Points | None = None
) -> Iterator[tuple[str, Matrix]]:
    """Yield the name and transform of every known normalisation.

    `poses` are those of all photographs, `points` the sparse points that the trainer started from.
    """
    yield "OpenSplat", normalize_opensplat(poses)
    for world in NERFSTUDIO_WORLDS:
        yield "nerfstudio", normalize_nerfstudio(poses, world)
    yield "gsplat", normalize_gsplat_cameras(poses)
    if points is not None and len(points) > 3:
        for transform in align_gsplat_axes(normalize_gsplat_cameras(poses), points):
            yield "gsplat", transform


def normalize_opensplat(poses: Poses) -> Matrix:
    """Centre on the mean camera and scale the largest camera coordinate to 1."""
    centers = poses[:, :3, 3]
    offsets = centers - centers.mean(axis=0)
    scale = 1 / max(np.abs(offsets).max(), 1e-12)
    return make_similarity(scale, np.eye(3), -scale * centers.mean(axis=0))


def normalize_nerfstudio(poses: Poses, world: Float[np.ndarray, "3 3"]) -> Matrix:
    """Rotate the mean up direction to z after the rotation `world`, then scale like OpenSplat."""
    up = -(poses[:, :3, 1] @ world.T).mean(axis=0)
    upright = make_similarity(
        1.0, align_directions(up, np.array([0.0, 0.0, 1.0])) @ world, np.zeros(3)
    )
    return (
        normalize_opensplat(np.stack([transform_pose(pose, upright) for pose in poses])) @ upright
    )


def normalize_gsplat_cameras(poses: Poses) -> Matrix:
    """Compute the camera half of gsplat's normalisation.

    Up becomes -y, the point that the cameras face the origin, and their median distance from it 1.
    """
    turn = align_directions(-poses[:, :3, 1].mean(axis=0), np.array([0.0, -1.0, 0.0]))
    centers, forward = poses[:, :3, 3] @ turn.T, poses[:, :3, 2] @ turn.T
    nearest = centers - (forward * centers).sum(axis=1, keepdims=True) * forward
    shift = -np.median(nearest, axis=0)
    scale = 1 / max(float(np.median(np.linalg.norm(centers + shift, axis=1))), 1e-12)
    return make_similarity(scale, turn, scale * shift)


def align_gsplat_axes(cameras: Matrix, points: Points) -> Iterator[Matrix]:
    """Yield the point half: principal axes become x, y and z, the largest first.

    Signs of eigenvectors depend on the library, and newer versions flip the scene upright: all four
    right-handed choices are yielded.
    """
    moved = points @ cameras[:3, :3].T + cameras[:3, 3]
    center = np.median(moved, axis=0)
    _, vectors = np.linalg.eigh(np.cov(moved - center, rowvar=False))
    axes = vectors[:, ::-1].T
    axes = axes * np.sign(np.linalg.det(axes))
    for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        turn = np.diag(np.array(signs, dtype=np.float64)) @ axes
        yield make_similarity(1.0, turn, -turn @ center) @ cameras


def align_directions(
    start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Compute the smallest rotation from one direction to a unit vector."""
    start = start / max(float(np.linalg.norm(start)), 1e-12)
    x, y, z = np.cross(start, end)
    cosine = float(start @ end)
    if cosine < -1 + 1e-8:
        return np.diag([-1.0, 1.0, -1.0]) if abs(end[1]) < 0.5 else np.diag([-1.0, -1.0, 1.0])
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)
