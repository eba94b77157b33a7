"""Bounds for the numbers of a camera, and their checks.

Files hold float64 and the pipeline uses float32, where 1e300 is infinity and 1e-300 is zero.
Numbers are checked once, on input. The bounds admit every real camera, and squares and quotients of
its numbers.
"""

from __future__ import annotations

from gscompleter.errors import InputError

MAX_SIDE = 16_384
"""Largest width or height of an image, in pixels."""
MAX_NUMBER = 1e12
"""Largest number of any kind in a camera file, such as a focal length in pixels."""
MAX_COORDINATE = 1e9
"""Largest coordinate of a camera centre, in scene units."""
FOCAL_RANGE = (1e-3, 1e6)
"""Range of focal lengths, in image widths (or heights)."""
MAX_CENTER = 100.0
"""Largest distance of the principal point from the corner, in image widths (or heights)."""
MAX_COEFFICIENT = 1e4
"""Largest lens coefficient."""
DEPTH_RANGE = (1e-9, 1e9)
"""Range of near and far planes and of depth map units, in scene units."""
MAX_PATH = 1024
"""Longest file path, in characters."""


def require(condition: object, sentence: str) -> None:
    """Raise an InputError with this sentence unless the condition is true."""
    if not condition:
        raise InputError(sentence)


def check_planes(near: float | None, far: float | None) -> None:
    """Raise an InputError if the near or far plane (scene units) is impossible."""
    low, high = DEPTH_RANGE
    for name, value in (("near", near), ("far", far)):
        require(
            value is None or low <= value <= high,
            f"The {name} plane at {value} is impossible; give a positive z-depth in scene units, "
            f"from {low:g} to {high:g}.",
        )
    require(
        near is None or far is None or near < far,
        f"The near plane at {near} is not before the far plane at {far}.",
    )
