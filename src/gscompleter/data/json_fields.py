"""Validated access to values of JSON objects.

Functions with a `title` raise an InputError that names the key and the title.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, compute_rotation
from gscompleter.data.limits import MAX_COORDINATE, MAX_IN_PIXELS, MAX_PATH, MAX_SIDE
from gscompleter.errors import InputError, quote_value


def get_object(content: Any, key: str) -> dict[Any, Any]:
    """Return the object at `key`; an empty one if there is none."""
    value = content.get(key) if isinstance(content, dict) else None
    return value if isinstance(value, dict) else {}


def get_list(content: Any, key: str) -> list[Any]:
    """Return the list at `key`; an empty one if there is none."""
    value = content.get(key) if isinstance(content, dict) else None
    return value if isinstance(value, list) else []


def get_optional_number(
    entry: Mapping[str, Any], key: str, title: str, low: float, high: float
) -> float | None:
    """Return the number at `key`, checked to lie in [low, high]; None if absent."""
    value = entry.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise InputError(
            f"The `{key}` of {title} is {quote_value(value)}; a number from {low:g} to {high:g} is "
            "needed."
        )
    return float(value)


def get_number(entry: Mapping[str, Any], key: str, title: str, low: float, high: float) -> float:
    """Return the number at `key`, checked to lie in [low, high]."""
    value = get_optional_number(entry, key, title, low, high)
    if value is None:
        raise InputError(f"The `{key}` of {title} is missing; add it.")
    return value


def get_size(entry: Mapping[str, Any], title: str) -> tuple[int, int]:
    """Return `width` and `height` in pixels."""
    size = [get_number(entry, key, title, 1.0, float(MAX_SIDE)) for key in ("width", "height")]
    if any(side != int(side) for side in size):
        raise InputError(f"The `width` and `height` of {title} are no whole numbers; correct them.")
    return int(size[0]), int(size[1])


def get_text(entry: Mapping[str, Any], key: str, title: str) -> str | None:
    """Return the path or name at `key`; None if absent."""
    value = entry.get(key)
    if value is not None and not (isinstance(value, str) and 0 < len(value) <= MAX_PATH):
        raise InputError(
            f"The `{key}` of {title} is {quote_value(value)}; the path of a file is needed."
        )
    return value


def get_array(
    entry: Mapping[str, Any], key: str, shape: tuple[int, ...], title: str
) -> Float[np.ndarray, "*n"]:
    """Return the nested list of numbers at `key` as an array of this shape."""
    array = convert_to_array(entry.get(key))
    if array.shape != shape:
        size = " × ".join(map(str, shape))
        raise InputError(f"The `{key}` of {title} is no list of {size} numbers; correct it.")
    return array


def convert_to_array(value: Any) -> Float[np.ndarray, "*n"]:
    """Convert nested lists of numbers to an array; an empty one if they are none."""
    try:
        return np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        return np.zeros(0)


def get_focal(entry: Mapping[str, Any], title: str) -> tuple[float, float]:
    """Return the focal lengths `fx` and `fy` in pixels."""
    low, high = 1 / MAX_IN_PIXELS, MAX_IN_PIXELS
    return get_number(entry, "fx", title, low, high), get_number(entry, "fy", title, low, high)


def get_intrinsics(entry: Mapping[str, Any], title: str) -> Intrinsics:
    """Return the intrinsics `fx`, `fy`, `cx` and `cy` in pixels, without an image size."""
    focal = get_focal(entry, title)
    cx, cy = (get_number(entry, key, title, -MAX_IN_PIXELS, MAX_IN_PIXELS) for key in ("cx", "cy"))
    return Intrinsics(None, focal, (cx, cy))


def get_pose(
    entry: Any, place: str, rotation: str, quaternion: Sequence[str], title: str
) -> Float[np.ndarray, "4 4"]:
    """Return a pose of x, y, z in the object `place` and a quaternion in the object `rotation`.

    `quaternion` lists the keys of its numbers, the real part first.
    """

    def get_numbers(part: str, keys: Sequence[str]) -> list[float]:
        numbers = get_object(entry, part)
        return [get_number(numbers, key, title, -MAX_COORDINATE, MAX_COORDINATE) for key in keys]

    pose = np.eye(4)
    pose[:3, :3] = compute_rotation(get_numbers(rotation, quaternion))
    pose[:3, 3] = get_numbers(place, "xyz")
    return pose
