"""Published weights: list, download, reading, and loading into networks."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gscompleter.models.weights.fetching import (
    WeightsNotAvailable,
    fetch,
    find_cached,
    get_cache_path,
)
from gscompleter.models.weights.published import PUBLISHED, PublishedWeights

if TYPE_CHECKING:
    from gscompleter.models.weights.fitting import load_strictly
    from gscompleter.models.weights.reading import read_state_dict

# Imported on first use, so that `gscompleter models` starts without torch.
_HOMES = {"load_strictly": "fitting", "read_state_dict": "reading"}

__all__ = [
    "PUBLISHED",
    "PublishedWeights",
    "WeightsNotAvailable",
    "fetch",
    "find_cached",
    "get_cache_path",
    "load_strictly",
    "read_state_dict",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gscompleter.models.weights' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gscompleter.models.weights.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
