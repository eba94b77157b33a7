"""Range images of a rotating laser: one row per beam, one column per direction.

The first row is the highest beam. Columns begin behind the laser and turn clockwise as seen from
above, in vehicle axes (x forward, y left, z up).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def compute_inclinations(
    values: Float[np.ndarray, "h"] | None, low: float, high: float, height: int
) -> Float[np.ndarray, "h"]:
    """Compute the elevation of each row in radians, highest first.

    `values` are ascending, or None if uniform between the beam edges `low` and `high`.
    """
    even = low + (np.arange(height) + 0.5) / height * (high - low)
    return (even if values is None else values)[::-1]


def compute_azimuths(width: int, extrinsic: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "w"]:
    """Compute the direction of each column in radians, in laser axes; the middle points ahead."""
    yaw = np.arctan2(extrinsic[1, 0], extrinsic[0, 0])
    return np.pi * (1 - 2 * (np.arange(width) + 0.5) / width) - yaw


def compute_points(
    ranges: Float[np.ndarray, "h w"],
    inclinations: Float[np.ndarray, "h"],
    extrinsic: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "h w 3"]:
    """Compute the measured points (metres) in the vehicle frame; `extrinsic` is the laser pose."""
    elevation = inclinations[:, None]
    azimuth = compute_azimuths(ranges.shape[1], extrinsic)[None]
    level = np.cos(elevation)
    up = np.broadcast_to(np.sin(elevation), ranges.shape)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=-1)
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
