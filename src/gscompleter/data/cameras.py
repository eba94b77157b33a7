"""Intrinsics as stored in files, and their validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gscompleter.data.limits import FOCAL_RANGE, MAX_CENTER, MAX_COORDINATE
from gscompleter.data.undistort import Distortion, Pinhole
from gscompleter.types import MAX_RIGID_ERROR

FRACTIONS = (1, 1)
"""`Intrinsics.size` of values in image widths and heights."""

FLOAT_NOISE = 1e-6
"""Largest deviation from a rotation that is kept as it is."""
SAME_ASPECT = 0.02
"""Relative difference of aspect ratios that rounding of sizes explains."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics as stored in a file; None for values that it omits."""

    size: tuple[int, int] | None
    """Width and height of the image that the values refer to; None for the photograph's."""
    focal: tuple[float | None, float | None]
    center: tuple[float | None, float | None] = (None, None)
    """Principal point; the image centre if None."""
    angle: tuple[float | None, float | None] = (None, None)
    """Full fields of view in radians, for files without focal lengths."""
    distortion: Distortion = Distortion()

    def compute_pinhole(self, width: int, height: int) -> Pinhole:
        """Compute the intrinsics of an image of this size, before undistortion."""
        w, h = self.size or (width, height)
        fl_x = _compute_focal(self.focal[0], self.angle[0], w)
        fl_y = _compute_focal(self.focal[1], self.angle[1], h)
        cx = w / 2 if self.center[0] is None else self.center[0]
        cy = h / 2 if self.center[1] is None else self.center[1]
        # With only one focal length, pixels are square.
        fl_x, fl_y = fl_y if fl_x is None else fl_x, fl_x if fl_y is None else fl_y
        assert fl_x is not None
        assert fl_y is not None
        return Pinhole(fl_x, fl_y, cx, cy, w, h).resize(width, height)

    def is_transposed(self, width: int, height: int) -> bool:
        """Check whether a photograph of this size is rotated by 90° relative to `size`."""
        w, h = self.size or (width, height)
        same = math.isclose(width * h, height * w, rel_tol=SAME_ASPECT)
        return not same and math.isclose(width * w, height * h, rel_tol=SAME_ASPECT)


def find_pinhole_defect(pinhole: Pinhole) -> str | None:
    """Describe why intrinsics are impossible; None if they are valid."""
    unit = pinhole.resize(1, 1)
    low, high = FOCAL_RANGE
    for focal in (unit.fl_x, unit.fl_y):
        if not low <= focal <= high:
            given = f"its focal length is {focal:g} times the size of the image"
            return f"{given}, which is not within {low:g} to {high:g}"
    for center in (unit.cx, unit.cy):
        if not abs(center) <= MAX_CENTER:
            given = f"its principal point lies {center:g} image sizes from the corner"
            return f"{given}, which is beyond {MAX_CENTER:g}"
    return None


def compute_fov(pinhole: Pinhole) -> float:
    """Compute the larger field of view of a camera, in degrees."""
    sides = ((pinhole.fl_x, pinhole.cx, pinhole.width), (pinhole.fl_y, pinhole.cy, pinhole.height))
    return math.degrees(
        max(math.atan(c / focal) + math.atan((side - c) / focal) for focal, c, side in sides)
    )


def _compute_focal(focal: float | None, angle: float | None, length: int) -> float | None:
    if focal is not None or angle is None:
        return focal
    return length / 2 / math.tan(angle / 2)


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
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows)
