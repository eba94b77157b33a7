"""Range images: what a turning laser measured, a row a beam and a column a direction.

The first row is the highest beam. Columns begin behind the laser and turn clockwise, as seen from
above, in the axes of the vehicle (x forward, y left, z up).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def inclinations_of(
    values: Float[np.ndarray, "h"] | None, low: float, high: float, height: int
) -> Float[np.ndarray, "h"]:
    """The elevation of each row in radians, the highest first.

    Args:
        values: Elevations in rising order; None where they are even from `low` to `high`.
        low: Lower end of the lowest beam, in radians.
        high: Upper end of the highest one.
        height: Rows of the range image.
    """
    even = low + (np.arange(height) + 0.5) / height * (high - low)
    return (even if values is None else values)[::-1]


def azimuths_of(width: int, extrinsic: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "w"]:
    """The direction of each column in radians, in the axes of the laser.

    The middle column looks along the vehicle: the yaw of the laser is taken off.
    """
    yaw = np.arctan2(extrinsic[1, 0], extrinsic[0, 0])
    return np.pi * (1 - 2 * (np.arange(width) + 0.5) / width) - yaw


def points_of(
    ranges: Float[np.ndarray, "h w"],
    inclinations: Float[np.ndarray, "h"],
    extrinsic: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "h w 3"]:
    """The measured points in the frame of the vehicle, in metres.

    Args:
        ranges: Distances from the laser in metres.
        inclinations: As `inclinations_of` has them.
        extrinsic: The pose of the laser on the vehicle.
    """
    elevation = inclinations[:, None]
    azimuth = azimuths_of(ranges.shape[1], extrinsic)[None]
    level = np.cos(elevation)
    up = np.broadcast_to(np.sin(elevation), ranges.shape)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=-1)
    return moved(ranges[..., None] * rays, extrinsic)


def moved(
    points: Float[np.ndarray, "*n 3"], pose: Float[np.ndarray, "*n 4 4"] | Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "*n 3"]:
    """Points in the frame that `pose` stands in, all by one pose or each by its own."""
    return (pose[..., :3, :3] @ points[..., None])[..., 0] + pose[..., :3, 3]


def poses_of(angles_and_places: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 4 4"]:
    """Poses told as roll, pitch, yaw (radians; rolled first, then pitched, then yawed), x, y, z."""
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
