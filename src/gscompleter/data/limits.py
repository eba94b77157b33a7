"""Between which bounds the numbers of a camera have to lie.

Files hold float64 and the pipeline works in float32, where 1e300 is infinity and 1e-300 is zero.
So numbers are compared with these bounds once, where they come in. The bounds leave room for
every real camera, and for the squares and quotients that are made of the numbers later.
"""

from __future__ import annotations

from gscompleter.errors import InputError

MAX_SIDE = 16_384
"""Largest width or height of an image, in pixels."""
MAX_IN_PIXELS = 1e12
"""Of focal lengths and principal points in pixels, before they are compared with the image."""
MAX_COORDINATE = 1e9
"""Farthest a camera may stand from the origin along an axis, in scene units."""
FOCAL_RANGE = (1e-3, 1e6)
"""Of focal lengths, in widths (or heights) of the image."""
MAX_CENTER = 100.0
"""Farthest the principal point may lie from the top-left pixel, in widths (or heights)."""
MAX_COEFFICIENT = 1e4
"""Of the coefficients of a lens."""
DEPTH_RANGE = (1e-9, 1e9)
"""Of near and far planes, and of the units of depth maps, in scene units."""

MAX_PATH = 1024
"""Of characters in the path of a file."""


def check_planes(near: float | None, far: float | None) -> None:
    """Raise an InputError where the near or the far plane (in scene units) is impossible."""
    low, high = DEPTH_RANGE
    for name, value in (("near", near), ("far", far)):
        if value is not None and not low <= value <= high:
            raise InputError(
                f"The {name} plane at {value:g} is impossible; give a positive z-depth in scene "
                f"units, from {low:g} to {high:g}."
            )
    if near is not None and far is not None and near >= far:
        raise InputError(f"The near plane at {near} is not before the far plane at {far}.")
