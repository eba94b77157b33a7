"""Values of JSON objects that somebody else wrote, checked where they are needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.limits import MAX_PATH, MAX_SIDE
from gscompleter.errors import InputError, quoted


def optional_number(
    entry: Mapping[str, Any], key: str, title: str, low: float, high: float
) -> float | None:
    """The number at `key`, within `low` to `high`; None where there is none.

    Raises:
        InputError: where something else is there.
    """
    value = entry.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise InputError(
            f"The `{key}` of {title} is {quoted(value)}; a number from {low:g} to {high:g} is "
            "needed."
        )
    return float(value)


def number_of(entry: Mapping[str, Any], key: str, title: str, low: float, high: float) -> float:
    """The number at `key`, within `low` to `high`.

    Raises:
        InputError: where there is none, or something else.
    """
    value = optional_number(entry, key, title, low, high)
    if value is None:
        raise InputError(f"The `{key}` of {title} is missing; add it.")
    return value


def size_of(entry: Mapping[str, Any], title: str) -> tuple[int, int]:
    """The numbers at `width` and `height`, in pixels.

    Raises:
        InputError: where one is missing or no whole number within the limits.
    """
    width, height = (
        number_of(entry, key, title, 1.0, float(MAX_SIDE)) for key in ("width", "height")
    )
    if width != int(width) or height != int(height):
        raise InputError(f"The `width` and `height` of {title} are no whole numbers; correct them.")
    return int(width), int(height)


def text_of(entry: Mapping[str, Any], key: str, title: str) -> str | None:
    """The path or name at `key`; None where there is none.

    Raises:
        InputError: where something else is there, or it is longer than any path.
    """
    value = entry.get(key)
    if value is not None and not (isinstance(value, str) and 0 < len(value) <= MAX_PATH):
        raise InputError(
            f"The `{key}` of {title} is {quoted(value)}; the path of a file is needed."
        )
    return value


def array_of(
    entry: Mapping[str, Any], key: str, shape: tuple[int, ...], title: str
) -> Float[np.ndarray, "*n"]:
    """The nested list of numbers at `key`.

    Raises:
        InputError: where it is missing or of another shape.
    """
    try:
        array = np.array(entry.get(key), dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape:
        size = " × ".join(map(str, shape))
        raise InputError(f"The `{key}` of {title} is no list of {size} numbers; correct it.")
    return array
