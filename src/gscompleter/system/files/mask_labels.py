"""Refusal of maps of labels that are given as masks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Shaped

from gscompleter.system.errors import InputError, join_names, quote_value

LEVEL_TOLERANCE = 0.1
"""Difference, relative to the range of a mask, below which two levels count as one: JPEG."""
MIN_LABEL_SHARE = 0.002
"""Smallest share of a mask that the flat pixels of a label fill."""
MAX_LABELS = 64
"""Most labels of a map; a soft gradient has more levels."""
MAX_LEVELS_NAMED = 4
"""Most labels that a sentence names."""


def refuse_labels(values: Shaped[np.ndarray, "h w c"], name: str) -> None:
    """Refuse a mask of more than two levels: nothing says which of the labels is meant.

    `name` is that of the mask, for the error.
    """
    levels = find_levels_between(values)
    if len(levels):
        shown = join_names([quote_value(level) for level in levels], MAX_LEVELS_NAMED)
        raise InputError(
            f"{name} is no mask of black and white but a map of labels: beside its "
            f"darkest and its brightest level it has {shown}; save what is meant in white, and all "
            "else in black."
        )


def find_levels_between(values: Shaped[np.ndarray, "h w c"]) -> list[object]:
    """Find the levels or colours of flat regions that are neither the darkest nor the brightest.

    Soft edges, and those of a JPEG, are no flat regions; a mask with more than `MAX_LABELS` of them
    is a gradient.
    """
    # Differences need a sign; large masks of 8 bits get no more than they need.
    wider = {"u": np.int64, "i": np.int64, "f": np.float64}[values.dtype.kind]
    exact = values.astype(np.int16 if values.dtype == np.uint8 else wider)
    brightness = exact.max(axis=-1)
    places = np.unravel_index([brightness.argmin(), brightness.argmax()], brightness.shape)
    darkest, brightest = exact[places]
    limit = LEVEL_TOLERANCE * (brightness.max() - brightness.min())
    is_dark = (np.abs(exact - darkest) <= limit).all(axis=-1)
    is_bright = (np.abs(exact - brightest) <= limit).all(axis=-1)
    between = ~(is_dark | is_bright)
    if between.mean() < MIN_LABEL_SHARE:
        return []
    # Flat: equal to the pixels on the left, on the right, above and below.
    inner = exact[1:-1, 1:-1]
    neighbours = (exact[1:-1, :-2], exact[1:-1, 2:], exact[:-2, 1:-1], exact[2:, 1:-1])
    is_flat = np.all([(inner == near).all(axis=-1) for near in neighbours], axis=0)
    colors, counts = np.unique(inner[is_flat & between[1:-1, 1:-1]], axis=0, return_counts=True)
    large = colors[counts >= MIN_LABEL_SHARE * between.size].tolist()
    if len(large) > MAX_LABELS:
        return []
    # A grey of three channels is named by one number.
    return [color[0] if len(set(color)) == 1 else tuple(color) for color in large]
