"""Camera-to-world poses in OpenCV axes and float64, and their validation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from gscompleter.data.limits import MAX_COORDINATE
from gscompleter.types import MAX_RIGID_ERROR

FLOAT_NOISE = 1e-6
"""Largest deviation from a rotation that is kept as it is."""


def find_pose_defect(pose: Float[np.ndarray, "4 4"]) -> str | None:
    """Describe why a pose is invalid; None for a rigid transform within the limits."""
    if not np.isfinite(pose).all():
        return "its pose holds NaN or infinity"
    if np.abs(pose).max() > MAX_COORDINATE:
        return f"its pose holds {np.abs(pose).max():g}, which is above {MAX_COORDINATE:g}"
    rotation = pose[:3, :3]
    errors = (rotation.T @ rotation - np.eye(3), pose[3] - [0, 0, 0, 1])
    if max(np.abs(error).max() for error in errors) > MAX_RIGID_ERROR:
        return "its pose is not a rigid transform but scaled, sheared or projective"
    if np.linalg.det(rotation) < 0:
        return "its pose is a reflection (its determinant is negative)"
    return None


def make_rigid(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Replace the rotation by the nearest exact one, unless it is within `FLOAT_NOISE`."""
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > FLOAT_NOISE:
        u, _, v = np.linalg.svd(rotation)
        rotation = u @ v
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation, pose[:3, 3]
    return rigid


def invert_viewmat(viewmat: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Invert a world-to-camera transform; an invalid one stays, so its defect is found later."""
    return viewmat if find_pose_defect(viewmat) is not None else np.linalg.inv(viewmat)


def compute_rotation(quaternion: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Compute the rotation of a quaternion (real part first, any length); NaN if it is zero."""
    q = np.array(quaternion, dtype=np.float64)
    with np.errstate(all="ignore"):
        q = q / np.abs(q).max()
        w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
