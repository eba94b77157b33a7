"""Validated access to values of JSON objects.

All functions raise an InputError that names the key and `title`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.limits import MAX_PATH, MAX_SIDE
from gscompleter.errors import InputError, quote_value


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
    width, height = (
        get_number(entry, key, title, 1.0, float(MAX_SIDE)) for key in ("width", "height")
    )
    if width != int(width) or height != int(height):
        raise InputError(f"The `width` and `height` of {title} are no whole numbers; correct them.")
    return int(width), int(height)


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
    try:
        array = np.array(entry.get(key), dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape:
        size = " × ".join(map(str, shape))
        raise InputError(f"The `{key}` of {title} is no list of {size} numbers; correct it.")
    return array
