"""Loops over views: several at a time on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from torch import Tensor

from gscompleter.numerics.kernels.parallel import map_small_tasks
from gscompleter.render.lod import MIN_PROXY_GAUSSIANS


def get_view_map(values: Tensor, num_gaussians: int = 0) -> Callable[..., Iterable[Any]]:
    """Return a `map` over views: several at a time if `values` are on a CPU, else one by one.

    A view of a large scene takes hundreds of megabytes until it is drawn, so that views of at least
    `MIN_PROXY_GAUSSIANS` are drawn one by one as well, each on all threads.
    """
    is_small = num_gaussians < MIN_PROXY_GAUSSIANS
    return map_small_tasks if is_small and values.device.type == "cpu" else map
