"""Loops over views: several at a time on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from torch import Tensor

from gscompleter.numerics.kernels.parallel import map_small_tasks


def get_view_map(values: Tensor) -> Callable[..., Iterable[Any]]:
    """Return a `map` over views: several at a time if `values` are on a CPU, else one by one."""
    return map_small_tasks if values.device.type == "cpu" else map
