"""Validated access to values of JSON objects.

Functions with a `title` raise an InputError that names the key and the title.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, compute_rotation
from gscompleter.data.limits import MAX_NUMBER, MAX_PATH, require
from gscompleter.system.errors import quote_value
from gscompleter.types import MAX_COORDINATE, MAX_IMAGE_SIDE

NUMBER_TYPES = (int, float, np.integer, np.floating)
JsonPart = TypeVar("JsonPart")


def get_part(entry: Any, key: str, kind: type[JsonPart]) -> JsonPart:
    """Return the list or object at `key`; an empty one if there is none."""
    value = _get(entry, key)
    return value if isinstance(value, kind) else kind()


def get_number(entry: Any, key: str, title: str, low: float, high: float) -> float:
    """Return the number at `key`, checked to lie in [low, high]."""
    value = _get(entry, key)
    require(value is not None, f"The `{key}` of {title} is missing; add it.")
    is_number = isinstance(value, NUMBER_TYPES) and not isinstance(value, bool)
    require(
        is_number and low <= value <= high,
        f"The `{key}` of {title} is {quote_value(value)}; a number from {low:g} to {high:g} is "
        "needed.",
    )
    return float(value)


def get_optional_number(entry: Any, key: str, title: str, low: float, high: float) -> float | None:
    """Return the number at `key`, checked to lie in [low, high]; None if absent."""
    return None if _get(entry, key) is None else get_number(entry, key, title, low, high)


def get_size(
    entry: Any, title: str, width: str = "width", height: str = "height"
) -> tuple[int, int]:
    """Return width and height in pixels, at the keys of these names."""
    w = get_number(entry, width, title, 1.0, float(MAX_IMAGE_SIDE))
    h = get_number(entry, height, title, 1.0, float(MAX_IMAGE_SIDE))
    require(
        w == int(w) and h == int(h),
        f"The `{width}` and `{height}` of {title} are no whole numbers; correct them.",
    )
    return int(w), int(h)


def get_text(entry: Any, key: str, title: str) -> str | None:
    """Return the path or name at `key`; None if absent."""
    value: str | None = _get(entry, key)
    require(
        value is None or (isinstance(value, str) and 0 < len(value) <= MAX_PATH),
        f"The `{key}` of {title} is {quote_value(value)}; the path of a file is needed.",
    )
    return value


def get_array(
    entry: Any, key: str, title: str, *shapes: tuple[int, ...]
) -> Float[np.ndarray, "*n"]:
    """Return the nested list of numbers or NaN at `key` as an array of one of these shapes."""
    try:
        array = np.array(_get(entry, key), dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        # A ragged list, text or a number beyond float64: refused below, since no shape is empty.
        array = np.zeros(0)
    sizes = " or ".join(" × ".join(map(str, shape)) for shape in shapes)
    require(
        # Not `<=`, which NaN would fail: a pose may hold it (`Frame.has_camera`).
        array.shape in shapes and not (np.abs(array) > MAX_NUMBER).any(),
        f"The `{key}` of {title} is no list of {sizes} numbers, none above {MAX_NUMBER:g}; correct "
        "it.",
    )
    return array


def get_focal(entry: Any, title: str) -> tuple[float, float]:
    """Return the focal lengths `fx` and `fy` in pixels."""
    low = 1 / MAX_NUMBER
    high = MAX_NUMBER
    fx = get_number(entry, "fx", title, low, high)
    fy = get_number(entry, "fy", title, low, high)
    return fx, fy


def get_intrinsics(entry: Any, title: str) -> Intrinsics:
    """Return the intrinsics `fx`, `fy`, `cx` and `cy` in pixels, without an image size."""
    focal = get_focal(entry, title)
    cx = get_number(entry, "cx", title, -MAX_NUMBER, MAX_NUMBER)
    cy = get_number(entry, "cy", title, -MAX_NUMBER, MAX_NUMBER)
    return Intrinsics(None, focal, (cx, cy))


def get_pose(
    entry: Any, place: str, rotation: str, quaternion: Sequence[str], title: str
) -> Float[np.ndarray, "4 4"]:
    """Return a pose of x, y, z in the object `place` and a quaternion in the object `rotation`.

    `quaternion` lists the keys of its numbers, the real part first.
    """

    def get_numbers(part: str, keys: Sequence[str]) -> list[float]:
        numbers = _get(entry, part)
        return [get_number(numbers, key, title, -MAX_COORDINATE, MAX_COORDINATE) for key in keys]

    pose = np.eye(4)
    pose[:3, :3] = compute_rotation(get_numbers(rotation, quaternion))
    pose[:3, 3] = get_numbers(place, "xyz")
    return pose


def _get(entry: Any, key: str) -> Any:
    """Return the value at `key`; None without one, or if `entry` is no object."""
    return entry.get(key) if isinstance(entry, dict) else None
