"""Progress bars and sentences, shown where somebody watches: the command line turns them on, a
library call stays silent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console

T = TypeVar("T")

_console: ContextVar[Console | None] = ContextVar("console", default=None)
_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


@contextmanager
def shown_on(console: Console | None) -> Iterator[None]:
    """Show the bars and sentences of everything called inside on `console`; None hides them."""
    token = _console.set(console)
    try:
        yield
    finally:
        _console.reset(token)


@contextmanager
def stages_heard_by(listener: Callable[[str], None]) -> Iterator[None]:
    """Let `listener` hear the name of each stage that begins in everything called inside."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def stage_begins(name: str) -> None:
    """Say which stage begins, where somebody listens."""
    listener = _listener.get()
    if listener is not None:
        listener(name)


def tell(sentence: str) -> None:
    """Print a sentence where bars are shown."""
    console = _console.get()
    if console is not None:
        console.print(sentence, highlight=False, markup=False, soft_wrap=True)


def track(items: Sequence[T], description: str) -> Iterable[T]:
    """`items`, one after the other, with a bar where bars are shown."""
    console = _console.get()
    if console is None:
        return items
    # Here, so that what shows no bars does not wait for it.
    from rich.progress import track as rich_track

    return rich_track(items, description, console=console, transient=True)
