"""Check annotations, shapes included, in the first call of each function in each test.

A completion calls small functions thousands of times: checks of all calls were 40 % of its CPU
time, and those of the first two calls a fifth.
"""

import inspect
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache, cached_property
from types import FunctionType
from typing import Any

import pytest
from beartype import beartype
from jaxtyping import jaxtyped

MOST_CHECKS = 2
"""Checks of a function in a test: of its arguments, and of the result with them."""

num_checks: Counter[tuple[str, str]] = Counter()
unchecked: list[FunctionType] = []
"""Functions that are not checked any more in this test."""
checkers: dict[tuple[Any, ...], Callable[..., Any]] = {}
"""Prepared checks, by the names of a function and its arguments, and by its annotations."""


def check_first_calls(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function that jaxtyping calls to check the arguments, or the result, of another.

    It has the name of the other function, and what it returns is not used. What is not called is
    not prepared, which would take seconds in each process.
    """
    name = (function.__module__, function.__qualname__)

    def check_and_count(*args: Any, **kwargs: Any) -> None:
        num_checks[name] += 1
        if num_checks[name] > MOST_CHECKS:
            return
        if num_checks[name] == MOST_CHECKS:
            stop_checking(*name)
        key = (*name, function.__code__.co_varnames, repr(function.__annotations__))
        if key not in checkers:
            checkers[key] = beartype(function)
        checkers[key](*args, **kwargs)

    return check_and_count


def leave_checked_functions(*found: Any, typechecker: Any) -> Any:
    """Decorate as `jaxtyping.jaxtyped` does, but leave what was checked in this test as it is.

    A function inside of another is decorated at each call of the other, in a millisecond.
    """
    decorate = jaxtyped(typechecker=typechecker)

    def decorate_unchecked(function: Any) -> Any:
        name = (getattr(function, "__module__", ""), getattr(function, "__qualname__", ""))
        is_checked = "<locals>" in name[1] and num_checks[name] >= MOST_CHECKS
        return function if is_checked else decorate(function)

    return decorate_unchecked(*found) if found else decorate_unchecked


@cache
def find_wrapped(module: str, qualified_name: str) -> list[FunctionType]:
    """Find a function or property and what it wraps; one inside of another is not found."""
    found: Any = sys.modules[module]
    for name in qualified_name.split("."):
        found = inspect.getattr_static(found, name, None)
    if isinstance(found, property):
        found = found.fget
    elif isinstance(found, cached_property):
        found = found.func
    elif isinstance(found, classmethod | staticmethod):
        found = found.__func__
    functions = []
    while found is not None:
        if isinstance(found, FunctionType):
            functions.append(found)
        found = getattr(found, "__wrapped__", None)
    return functions


def stop_checking(module: str, qualified_name: str) -> None:
    """Let calls of a function pass until another test begins."""
    for function in find_wrapped(module, qualified_name):
        # jaxtyping looks for this name before it checks a call.
        function.__no_type_check__ = True  # type: ignore[attr-defined]
        unchecked.append(function)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Check all functions anew, so that no test depends on those before."""
    while unchecked:
        vars(unchecked.pop()).pop("__no_type_check__", None)
    num_checks.clear()
