"""Samples of a sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def sample_evenly(items: Sequence[T], count: int) -> list[T]:
    """Sample up to `count` different items at even steps, the first and the last among them."""
    steps = np.linspace(0, len(items) - 1, min(len(items), count)).round().astype(int)
    return [items[step] for step in steps]
