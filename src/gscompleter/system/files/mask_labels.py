"""Refusal of maps of labels that are given as masks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Shaped

from gscompleter.system.errors import InputError, join_names, quote_value

LEVEL_TOLERANCE = 0.1
"""Difference, relative to the range of a mask, below which two levels count as one: JPEG."""
MAX_OVERSHOOT = 0.35
"""Largest overshoot of an edge of a JPEG, relative to the same range."""
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

    The brightness of a colour is its largest channel, as `read_mask` reads it. Soft edges, and
    those of a JPEG, are no flat regions; a mask with more than `MAX_LABELS` of them is a gradient.
    """
    # Differences need a sign; large masks of 8 bits get no more than they need.
    wider = {"u": np.int64, "i": np.int64, "f": np.float64}[values.dtype.kind]
    signed = values.astype(np.int16 if values.dtype == np.uint8 else wider)
    brightness = signed.max(axis=-1)
    places = np.unravel_index([brightness.argmin(), brightness.argmax()], brightness.shape)
    darkest, brightest = signed[places]
    spread = float(brightness.max() - brightness.min())
    # Most masks are done here, without a look for flat regions.
    if is_between(signed, darkest, brightest, spread).mean() < MIN_LABEL_SHARE:
        return []

    colors = find_flat_colors(signed)
    is_white = colors.max(axis=-1) > brightness.max() / 2
    darkest = leave_out_overshoot(darkest, colors[~is_white], spread)
    brightest = leave_out_overshoot(brightest, colors[is_white], spread)
    labels = colors[is_between(colors, darkest, brightest, spread)].tolist()
    if len(labels) > MAX_LABELS:
        return []
    # A grey of three channels is named by one number.
    return [color[0] if len(set(color)) == 1 else tuple(color) for color in labels]


def is_between(
    colors: Shaped[np.ndarray, "*shape c"],
    darkest: Shaped[np.ndarray, "c"],
    brightest: Shaped[np.ndarray, "c"],
    spread: float,
) -> Bool[np.ndarray, "*shape"]:
    """Find the colours that are neither level of a mask whose brightness ranges over `spread`."""
    limit = LEVEL_TOLERANCE * spread
    is_dark = (np.abs(colors - darkest) <= limit).all(axis=-1)
    is_bright = (np.abs(colors - brightest) <= limit).all(axis=-1)
    return ~(is_dark | is_bright)


def find_flat_colors(pixels: Shaped[np.ndarray, "h w c"]) -> Shaped[np.ndarray, "n c"]:
    """Find the colours whose flat pixels fill at least `MIN_LABEL_SHARE` of an image."""
    # Flat: equal to the pixels on the left, on the right, above and below.
    inner = pixels[1:-1, 1:-1]
    neighbours = (pixels[1:-1, :-2], pixels[1:-1, 2:], pixels[:-2, 1:-1], pixels[2:, 1:-1])
    is_flat = np.all([(inner == near).all(axis=-1) for near in neighbours], axis=0)
    flat = inner[is_flat]
    # One number per pixel sorts faster than rows, and in their order. Several channels have 8 bits.
    codes = flat @ 256 ** np.arange(pixels.shape[-1])[::-1]
    _, places, counts = np.unique(codes, return_index=True, return_counts=True)
    num_pixels = pixels.shape[0] * pixels.shape[1]
    return flat[places[counts >= MIN_LABEL_SHARE * num_pixels]]


def leave_out_overshoot(
    extreme: Shaped[np.ndarray, "c"], colors: Shaped[np.ndarray, "n c"], spread: float
) -> Shaped[np.ndarray, "c"]:
    """Return the flat colour that an extreme pixel overshoots, or the pixel itself without one.

    The edges of a JPEG overshoot both of their sides, most of all where these are no pure black or
    white. `colors` are the flat ones on the same side of a mask.
    """
    if len(colors) == 0:
        return extreme
    distances = np.abs(colors - extreme).max(axis=-1)
    nearest = distances.argmin()
    return colors[nearest] if distances[nearest] <= MAX_OVERSHOOT * spread else extreme
