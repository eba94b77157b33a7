"""Code that is found by its name: tables of installed packages, and functions of higher floors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any


@cache
def load_plugins(group: str) -> dict[str, Any]:
    """Merge the tables that the entry points of a group name: from a model's name to its loader."""
    table: dict[str, Any] = {}
    for point in entry_points(group=group):
        table |= point.load()
    return table


def load_function(module: str, name: str) -> Callable[..., Any]:
    """Import a function by its name.

    Values know by it what is done with them on a higher floor, which they must not import.
    """
    function: Callable[..., Any] = getattr(import_module(module), name)
    return function
