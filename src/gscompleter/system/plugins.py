"""Tables of models that installed packages add to the built-in ones, through entry points."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from typing import Any


@cache
def load_plugins(group: str) -> dict[str, Any]:
    """Merge the tables that the entry points of a group name: from a model's name to its loader."""
    table: dict[str, Any] = {}
    for point in entry_points(group=group):
        table |= point.load()
    return table
