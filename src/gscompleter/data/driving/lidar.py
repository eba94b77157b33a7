"""Points of lasers: sweeps, range images, and sparse z-depth from points.

A range image of a rotating laser has one row per beam, the highest first, and one column per
direction. Columns begin behind the laser and turn clockwise as seen from above, in vehicle axes
(x forward, y left, z up).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError, quote_value
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
    if len(data) % POINT_BYTES:
        raise InputError(
            f"{quote_value(path)} is truncated: it ends within a point; copy it again."
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    return transform_finite(points, world_from_laser)


def transform_finite(
    points: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "m 3"]:
    """Transform the finite points from the local frame of `pose`."""
    finite = points[np.isfinite(points).all(axis=1)]
    return finite @ pose[:3, :3].T + pose[:3, 3]


def compute_points(
    ranges: Float[np.ndarray, "h w"],
    elevations: Float[np.ndarray, "h"],
    extrinsic: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "h w 3"]:
    """Compute the points (metres) of a range image in the vehicle frame.

    `elevations` of the rows are in radians, `extrinsic` is the pose of the laser. The middle
    column points ahead.
    """
    width = ranges.shape[1]
    yaw = np.arctan2(extrinsic[1, 0], extrinsic[0, 0])
    azimuths = np.pi * (1 - 2 * (np.arange(width) + 0.5) / width) - yaw
    level, up = np.cos(elevations)[:, None], np.sin(elevations)[:, None]
    up = np.broadcast_to(up, ranges.shape)
    rays = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), up], axis=-1)
    return transform_points(ranges[..., None] * rays, extrinsic)


def transform_points(
    points: Float[np.ndarray, "*n 3"], pose: Float[np.ndarray, "*n 4 4"] | Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "*n 3"]:
    """Transform points from the local frame of `pose`, one for all or one per point."""
    return (pose[..., :3, :3] @ points[..., None])[..., 0] + pose[..., :3, 3]


def build_poses(angles_and_places: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 4 4"]:
    """Build poses from roll, pitch, yaw (radians; rolled first, yawed last) and x, y, z."""
    (sr, sp, sy), (cr, cp, cy) = (
        np.moveaxis(turn(angles_and_places[..., :3]), -1, 0) for turn in (np.sin, np.cos)
    )
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    poses = np.zeros((*angles_and_places.shape[:-1], 4, 4))
    poses[..., :3, :3] = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    poses[..., :3, 3] = angles_and_places[..., 3:]
    poses[..., 3, 3] = 1
    return poses
