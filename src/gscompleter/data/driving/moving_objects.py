"""Boxes around moving objects, and the pixels that they cover."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations, product

import cv2
import numpy as np
from jaxtyping import Bool, Float

from gscompleter.data.driving.lidar import build_poses, transform_points
from gscompleter.types import Camera

MIN_SPEED = 0.5
"""Smallest speed of a moving object, in metres per second."""
MARGIN = 0.1
"""Relative enlargement of a box, for shadows, mirrors and time offsets."""
NEAREST = 0.1
"""z-depth at which a box is clipped, in metres."""
MAX_PIXELS = 1e5
"""Largest pixel coordinate of a projected corner; rasterisers use integers."""


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
