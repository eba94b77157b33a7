"""Poses on a vehicle, points of its laser, and sparse z-depth from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.limits import require
from gscompleter.errors import quote_value
from gscompleter.geometry import is_inside, project
from gscompleter.io.reading import read_bytes
from gscompleter.types import Camera

POINT_BYTES = 16
"""Size of a point of KITTI: x, y, z and reflectance as float32."""
MAX_SWEEP = 1 << 28
"""Largest sweep, in bytes."""


def compute_sparse_depth(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "h w"]:
    """Project points to z-depth in scene units: the nearest per pixel, 0 without one.

    Points behind an unmeasured surface remain visible.
    """
    pixels, z = project(points, camera)
    seen = is_inside(pixels, z, camera)
    x, y = pixels[seen].long().unbind(-1)
    nearest = torch.full((camera.height * camera.width,), torch.inf)
    nearest = nearest.scatter_reduce(0, y * camera.width + x, z[seen], "amin")
    return nearest.where(nearest.isfinite(), 0.0).view(camera.height, camera.width)


def read_sweep(path: Path, world_from_laser: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    """Read the points of a sweep of KITTI in the world frame, in metres."""
    data = read_bytes(path, MAX_SWEEP)
    require(
        len(data) % POINT_BYTES == 0,
        f"{quote_value(path)} is truncated: it ends within a point; copy it again.",
    )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    return transform_finite(points, world_from_laser)


def transform_finite(
    points: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "m 3"]:
    """Transform the finite points from the local frame of `pose`."""
    return transform_points(points[np.isfinite(points).all(axis=1)], pose)


def transform_points(
    points: Float[np.ndarray, "*n 3"], pose: Float[np.ndarray, "*n 4 4"] | Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "*n 3"]:
    """Transform points from the local frame of `pose`, one for all or one per point."""
    return (pose[..., :3, :3] @ points[..., None])[..., 0] + pose[..., :3, 3]


def build_poses(angles_and_places: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 4 4"]:
    """Build poses from roll, pitch, yaw (radians; rolled first, yawed last) and x, y, z."""
    from scipy.spatial.transform import Rotation

    angles, places = np.split(np.asarray(angles_and_places), 2, axis=-1)
    turns = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_matrix()
    poses = np.zeros((*places.shape[:-1], 4, 4))
    poses[..., :3, :3] = turns.reshape(*places.shape[:-1], 3, 3)
    poses[..., :3, 3] = places
    poses[..., 3, 3] = 1
    return poses
