"""Bounds for the numbers of a camera, and their checks.

Numbers of files are checked once, on input; `types` has the bounds that `Camera` checks too.
"""

from __future__ import annotations

from numbers import Real

from gscompleter.system.errors import InputError

MAX_NUMBER = 1e12
"""Largest number of any kind in a camera file, such as a focal length in pixels."""
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
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        require(
            value is None or (is_number and low <= value <= high),
            f"The {name} plane at {value} is impossible; give a positive z-depth in scene units, "
            f"from {low:g} to {high:g}.",
        )
    require(
        near is None or far is None or near < far,
        f"The near plane at {near} is not before the far plane at {far}.",
    )
