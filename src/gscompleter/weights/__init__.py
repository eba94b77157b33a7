"""Published weights: list, download, reading, and loading into networks."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gscompleter.weights.fetching import WeightsNotAvailable, fetch, find_cached, get_cache_path
from gscompleter.weights.published import PUBLISHED, PublishedWeights

if TYPE_CHECKING:
    from gscompleter.weights.fitting import load_strictly
    from gscompleter.weights.reading import read_state_dict

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
        raise AttributeError(f"module 'gscompleter.weights' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gscompleter.weights.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
