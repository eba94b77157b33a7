"""Poses on a vehicle, its laser points as sparse z-depth, and the boxes of moving objects."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.limits import require
from gscompleter.system.errors import quote_value
from gscompleter.system.files.reading import read_bytes

POINT_BYTES = 16
"""Size of a point of KITTI: x, y, z and reflectance as float32."""
MIN_SPEED = 0.5
"""Smallest speed of a moving object over ground, in metres per second."""
BOX_MARGIN = 0.1
"""Relative enlargement of a box, for shadows, mirrors and time offsets."""


def read_sweep(path: Path, world_from_laser: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    """Read the points of a sweep of KITTI in the world frame, in metres."""
    data = read_bytes(path)
    require(
        len(data) % POINT_BYTES == 0,
        f"{quote_value(path)} is truncated: it ends within a point; copy it again.",
    )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    return transform_points(points, world_from_laser)


def transform_points(
    points: Float[np.ndarray, "*#n 3"], pose: Float[np.ndarray, "*#n 4 4"]
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


def compute_moving_boxes(
    world_from_local: Float[np.ndarray, "4 4"], objects: Float[np.ndarray, "n _"]
) -> Float[np.ndarray, "m 8 3"]:
    """Compute the enlarged corners of moving boxes in the world frame, in metres.

    A row of `objects` has the middle of a box that stands upright in the local frame (z up), which
    is that of the vehicle or of its laser; its length along the heading, width and height in
    metres; the heading in radians from x towards y; then its velocity over ground in metres per
    second, in any axes, which is NaN if unknown.
    """
    # Not `>=`: an unknown speed is NaN, and such an object counts as moving.
    moving = objects[~(np.linalg.norm(objects[:, 7:], axis=1) < MIN_SPEED)]
    centers, sides, headings = np.split(moving[:, :7], [3, 6], axis=1)
    # Boxes stand level in the local frame: only the yaw turns them.
    level = np.zeros((len(moving), 2))
    poses = world_from_local @ build_poses(np.concatenate([level, headings, centers], axis=1))
    # Signs of the eight corners, from the centre of a box of side 1.
    signs = np.array(list(product((-0.5, 0.5), repeat=3)))
    return transform_points((1 + BOX_MARGIN) * sides[:, None] * signs, poses[:, None])
