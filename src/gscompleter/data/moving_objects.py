"""Boxes around things that move, and what of an image they cover."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations, product

import cv2
import numpy as np
from jaxtyping import Bool, Float

from gscompleter.types import Camera

MIN_SPEED = 0.5
"""Metres a second from which a thing counts as moving."""
MARGIN = 0.1
"""By how much a box is widened, in its sides: shadows, mirrors, and the time since it was drawn."""
NEAREST = 0.1
"""z-depth at which a box is cut off, in metres."""
MAX_PIXELS = 1e5
"""Farthest corner of a projected box, in pixels from the image's: rasterisers count in integers."""


@dataclass(frozen=True, eq=False)
class Box:
    """A box around one thing."""

    pose: Float[np.ndarray, "4 4"]
    """Its centre and the directions of its sides, in the world frame."""
    sides: tuple[float, float, float]
    """Its lengths along its own axes, in metres."""
    speed: float | None
    """In metres a second; None where it is not known."""

    @property
    def moves(self) -> bool:
        """Whether the thing moves. One whose speed is not known may, so it counts."""
        return self.speed is None or not self.speed < MIN_SPEED

    def corners(self) -> Float[np.ndarray, "8 3"]:
        """Its corners in the world frame, once it is widened."""
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        local = signs * np.array(self.sides) * (1 + MARGIN)
        return local @ self.pose[:3, :3].T + self.pose[:3, 3]


def upright(center: Float[np.ndarray, "3"], heading: float) -> Float[np.ndarray, "4 4"]:
    """The pose of a box that stands upright (z up), turned by `heading` radians."""
    pose = np.eye(4)
    cos, sin = np.cos(heading), np.sin(heading)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:3, 3] = center
    return pose


def covered(
    boxes: Iterable[Box], camera: Camera, origin: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "h w"]:
    """Where moving boxes lie before a camera; what stands before them is covered as well.

    Args:
        boxes: In the world frame of the files.
        camera: Told from `origin`.
        origin: Where its coordinates are counted from.
    """
    mask = np.zeros((camera.height, camera.width), np.uint8)
    for box in boxes:
        outline = _outline(box.corners() - origin, camera) if box.moves else None
        if outline is not None:
            cv2.fillConvexPoly(mask, outline, 1)
    return mask > 0


def _outline(corners: Float[np.ndarray, "8 3"], camera: Camera) -> np.ndarray | None:
    """The convex outline of a box in the image, in whole pixels; None where it lies behind."""
    c2w, K = (matrix.double().cpu().numpy() for matrix in (camera.c2w, camera.K))
    local = (corners - c2w[:3, 3]) @ c2w[:3, :3]
    if not np.isfinite(local).all() or local[:, 2].max() <= NEAREST:
        return None
    shown = _before(local)
    pixels = (shown @ K.T)[:, :2] / shown[:, 2:]
    # The centre of the first pixel is (0, 0) here.
    pixels = np.clip(pixels - 0.5, -MAX_PIXELS, MAX_PIXELS)
    return cv2.convexHull(np.rint(pixels).astype(np.int32))


def _before(corners: Float[np.ndarray, "8 3"]) -> Float[np.ndarray, "n 3"]:
    """The corners of the part of a box, in camera axes, that is farther away than `NEAREST`."""
    kept = [corner for corner in corners if corner[2] > NEAREST]
    for a, b in combinations(corners, 2):
        if (a[2] > NEAREST) != (b[2] > NEAREST):
            kept.append(a + (NEAREST - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(kept)
