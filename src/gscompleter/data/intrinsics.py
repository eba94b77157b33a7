"""Intrinsics as files give them, and what makes them impossible."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gscompleter.data.lens import Distortion, Pinhole
from gscompleter.data.limits import FOCAL_RANGE, MAX_CENTER

FRACTIONS = (1, 1)
"""The `Intrinsics.size` of focal lengths and centres in widths and heights of the image."""

SAME_ASPECT = 0.02
"""Relative difference of two aspect ratios that the rounding of sizes explains."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics as a file gives them. None stands for what it leaves out."""

    size: tuple[int, int] | None
    """Width and height of the image that the values belong to; None for that of the photograph."""
    focal: tuple[float | None, float | None]
    center: tuple[float | None, float | None] = (None, None)
    """Principal point; the middle of the image if left out."""
    angle: tuple[float | None, float | None] = (None, None)
    """Full opening angles in radians, for files that give them in place of focal lengths."""
    distortion: Distortion = Distortion()

    def at(self, width: int, height: int) -> Pinhole:
        """The intrinsics of an image of that size, before its distortion is removed."""
        w, h = self.size or (width, height)
        fl_x = _focal(self.focal[0], self.angle[0], w)
        fl_y = _focal(self.focal[1], self.angle[1], h)
        cx = w / 2 if self.center[0] is None else self.center[0]
        cy = h / 2 if self.center[1] is None else self.center[1]
        # Where only one of the two is known, pixels are square.
        known = fl_y if fl_x is None else fl_x
        assert known is not None
        fl_x, fl_y = known if fl_x is None else fl_x, known if fl_y is None else fl_y
        return Pinhole(fl_x, fl_y, cx, cy, w, h).resized(width, height)

    def transposed(self, width: int, height: int) -> bool:
        """Whether a photograph of that size lies on its side against what the file says."""
        w, h = self.size or (width, height)
        same = math.isclose(width * h, height * w, rel_tol=SAME_ASPECT)
        return not same and math.isclose(width * w, height * h, rel_tol=SAME_ASPECT)


def pinhole_defect(pinhole: Pinhole) -> str | None:
    """What makes a camera's intrinsics impossible; None where they are possible."""
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


def opening_angle(pinhole: Pinhole) -> float:
    """The larger of a camera's two opening angles, in degrees."""
    sides = ((pinhole.fl_x, pinhole.cx, pinhole.width), (pinhole.fl_y, pinhole.cy, pinhole.height))
    return math.degrees(
        max(math.atan(c / focal) + math.atan((side - c) / focal) for focal, c, side in sides)
    )


def _focal(focal: float | None, angle: float | None, length: int) -> float | None:
    if focal is not None or angle is None:
        return focal
    return length / 2 / math.tan(angle / 2)
