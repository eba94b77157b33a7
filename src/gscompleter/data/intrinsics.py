"""Intrinsics as stored in files, and their validation."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gscompleter.data.lens import Distortion, Pinhole
from gscompleter.data.limits import FOCAL_RANGE, MAX_CENTER

FRACTIONS = (1, 1)
"""`Intrinsics.size` of values in image widths and heights."""

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
        known = fl_y if fl_x is None else fl_x
        assert known is not None
        fl_x, fl_y = known if fl_x is None else fl_x, known if fl_y is None else fl_y
        return Pinhole(fl_x, fl_y, cx, cy, w, h).resize(width, height)

    def is_transposed(self, width: int, height: int) -> bool:
        """Check whether a photograph of this size is rotated by 90° relative to `size`."""
        w, h = self.size or (width, height)
        same = math.isclose(width * h, height * w, rel_tol=SAME_ASPECT)
        return not same and math.isclose(width * w, height * h, rel_tol=SAME_ASPECT)


def find_pinhole_defect(pinhole: Pinhole) -> str | None:
    """Describe why intrinsics are impossible; None if they are valid."""
    low, high = FOCAL_RANGE
    for focal, side in ((pinhole.fl_x, pinhole.width), (pinhole.fl_y, pinhole.height)):
        if not low <= focal / side <= high:
            given = f"its focal length is {focal / side:g} times the size of the image"
            return f"{given}, which is not within {low:g} to {high:g}"
    for center, side in ((pinhole.cx, pinhole.width), (pinhole.cy, pinhole.height)):
        if not abs(center / side) <= MAX_CENTER:
            given = f"its principal point lies {center / side:g} image sizes from the corner"
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
