"""Old public names, which work for one release and warn."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping
from functools import wraps
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def warn_deprecated(old: str, new: str) -> None:
    """Warn the caller of a function that used an old name of the public interface."""
    warnings.warn(
        f"{old} is deprecated and stops working in the next release; use {new}.",
        DeprecationWarning,
        stacklevel=3,
    )


class RenamedMembers:
    """A class whose old member names still work."""

    old_names: ClassVar[Mapping[str, str]] = {}
    """New name of each old one."""

    if not TYPE_CHECKING:  # else every attribute would be valid

        def __getattr__(self, name: str) -> Any:
            kind = type(self)
            if name not in kind.old_names:
                raise AttributeError(f"{kind.__name__!r} object has no attribute {name!r}")
            warn_deprecated(f"{kind.__name__}.{name}", kind.old_names[name])
            return getattr(self, kind.old_names[name])


def accept_old_keywords(**names: str) -> Callable[[F], F]:
    """Let a function take old keywords, each given with its new name."""

    def decorate(function: F) -> F:
        @wraps(function)
        def call(*arguments: Any, **keywords: Any) -> Any:
            for old in names.keys() & keywords.keys():
                warn_deprecated(f"{old}=", f"{names[old]}=")
                keywords[names[old]] = keywords.pop(old)
            return function(*arguments, **keywords)

        return call  # type: ignore[return-value]

    return decorate


def resolve_old_name(module: str, name: str, names: Mapping[str, str]) -> Any:
    """Return what an old name of a module stands for; the body of a module's `__getattr__`."""
    if name not in names:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    warn_deprecated(f"{module}.{name}", names[name])
    return getattr(sys.modules[module], names[name])
