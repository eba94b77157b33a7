"""Poses on a vehicle, its laser points as sparse z-depth, and boxes of moving objects as masks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
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
MIN_SPEED = 0.5
"""Smallest speed of a moving object, in metres per second."""
MARGIN = 0.1
"""Relative enlargement of a box, for shadows, mirrors and time offsets."""
NEAREST = 0.1
"""z-depth at which a box is clipped, in metres."""
MAX_PIXELS = 1e5
"""Largest pixel coordinate of a projected corner; rasterisers use integers."""


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


@dataclass(frozen=True, eq=False)
class Box:
    """A box around one object."""

    pose: Float[np.ndarray, "4 4"]
    """Centre and axes, in the world frame."""
    sides: Float[np.ndarray, "3"]
    """Side lengths along its own axes, in metres."""
    speed: float
    """Speed in metres per second, or NaN if unknown."""

    @property
    def is_moving(self) -> bool:
        """True if the object moves or its speed is unknown."""
        return not self.speed < MIN_SPEED

    def compute_corners(self) -> Float[np.ndarray, "8 3"]:
        """Compute the corners of the enlarged box in the world frame."""
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        return transform_points(signs * self.sides * (1 + MARGIN), self.pose)


def build_box(
    vehicle: Float[np.ndarray, "4 4"],
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    heading: float,
    velocity: Float[np.ndarray, "_"],
) -> Box:
    """Build the upright box (z up) at `center` on a vehicle, rotated by `heading` radians."""
    pose = vehicle @ build_poses(np.array([0.0, 0.0, heading, *center]))
    return Box(pose, sides, float(np.linalg.norm(velocity)))


def mask_moving(
    boxes: Iterable[Box], camera: Camera, origin: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "h w"]:
    """Mask pixels covered by moving boxes, including occluders in front of them.

    `boxes` are in the world frame of the files, `camera` in coordinates relative to `origin`.
    """
    mask = np.zeros((camera.height, camera.width), np.uint8)
    for box in boxes:
        outline = _compute_outline(box.compute_corners() - origin, camera)
        if box.is_moving and outline is not None:
            cv2.fillConvexPoly(mask, outline, 1)
    return mask > 0


def _compute_outline(corners: Float[np.ndarray, "8 3"], camera: Camera) -> np.ndarray | None:
    """Compute the convex outline of a box in whole pixels; None if it is behind the camera."""
    c2w, K = (matrix.double().cpu().numpy() for matrix in (camera.c2w, camera.K))
    local = (corners - c2w[:3, 3]) @ c2w[:3, :3]
    if not np.isfinite(local).all() or local[:, 2].max() <= NEAREST:
        return None
    # The box is clipped at `NEAREST`.
    shown = [corner for corner in local if corner[2] > NEAREST]
    for a, b in combinations(local, 2):
        if (a[2] > NEAREST) != (b[2] > NEAREST):
            shown.append(a + (NEAREST - a[2]) / (b[2] - a[2]) * (b - a))
    points = np.array(shown)
    pixels = (points @ K.T)[:, :2] / points[:, 2:]
    # OpenCV puts the centre of the first pixel at (0, 0).
    pixels = np.clip(pixels - 0.5, -MAX_PIXELS, MAX_PIXELS)
    return cv2.convexHull(np.rint(pixels).astype(np.int32))
