"""Local origins of splats whose coordinates are too large for float32, such as those of maps.

At 5,000,000 m float32 has steps of half a metre, which swallow Gaussians of two centimetres. Files
that hold positions more exactly are read relative to a place near their middle
(`Gaussians.origin`), and writers add it again: the frame of a scene is the local one, that of its
file lies at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gscompleter.types import Gaussians, Origin

LEAST_DIGITS = 4
"""Fewest digits of a coordinate in a sentence."""
MOST_DIGITS = 15
"""Digits that float64 holds."""
MAX_POSITION_STEP = 0.01
"""Largest step of positions, relative to the size of the median Gaussian."""


def find_step(coordinate: float) -> float:
    """Find the distance of neighbouring numbers of float32 at a coordinate."""
    return float(np.spacing(np.float32(abs(coordinate))))


def count_digits(low: float, high: float) -> int:
    """Count the digits that tell the ends of a range apart to a thousandth of it, at least four."""
    largest = max(abs(low), abs(high))
    digits = LEAST_DIGITS
    if 0 < high - low < largest:
        digits += math.ceil(math.log10(largest / (high - low)))
    return min(digits, MOST_DIGITS)


def format_corners(low: Sequence[float], high: Sequence[float]) -> tuple[str, str]:
    """Format the smallest and the largest corner of a box with digits that tell its sides."""
    pairs = list(zip(low, high, strict=True))
    corners = [" ".join(f"{pair[end]:.{count_digits(*pair)}g}" for pair in pairs) for end in (0, 1)]
    return corners[0], corners[1]


def is_too_far(middle: Float[ndarray, "3"], size: float) -> bool:
    """Return True if float32 would round positions near `middle` visibly.

    `size` is that of the median Gaussian, in scene units.
    """
    farthest = float(np.abs(middle).max())
    # A size of zero tells nothing of what is visible.
    return math.isfinite(farthest) and 0 < MAX_POSITION_STEP * size < find_step(farthest)


def choose_origin(middle: Float[ndarray, "3"], size: float) -> Origin | None:
    """Choose the origin for positions near `middle`, in whole scene units; None for zero.

    `size` is that of the median Gaussian. None where float32 serves as well: positions are exact
    enough, or so near zero that no whole unit can be taken off.
    """
    if not is_too_far(middle, size):
        return None
    x, y, z = middle.round().tolist()
    return (x, y, z) if any((x, y, z)) else None


def measure_size(gaussians: Gaussians) -> float:
    """Measure the size of the median Gaussian: its largest standard deviation, in scene units."""
    if len(gaussians) == 0:
        return 0.0
    return float(gaussians.scales.amax(dim=1).median())


def measure_distance(gaussians: Gaussians, others: Gaussians) -> float:
    """Measure the largest distance of Gaussians from others in their order, in scene units.

    Either may have an origin; they are compared in the coordinates of their files.
    """
    places = [
        scene.means.double().cpu() + torch.tensor(scene.origin or (0, 0, 0), dtype=torch.float64)
        for scene in (gaussians, others)
    ]
    return float((places[0] - places[1]).norm(dim=1).max())
