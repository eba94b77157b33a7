"""Progress on stderr: live lines on a terminal, otherwise log lines."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

T = TypeVar("T")

LOG_SECONDS = 10.0
"""Seconds between log lines of counted steps."""


@dataclass(eq=False)
class Activity:
    """A running stage, or a number of counted steps."""

    name: str
    total: int | None = None
    """Number of steps; None for a stage."""
    num_done: int = 0

    def format_label(self) -> str:
        """Return the name, with the number of the current step."""
        if self.total is None:
            return self.name
        return f"{self.name} {min(self.num_done + 1, self.total)} of {self.total}"


class Display:
    """The running activities on a console, the outermost first."""

    def __init__(self, console: Console) -> None:
        self.has_bars = console.is_terminal and not console.is_dumb_terminal
        self._console = console
        self._bars: Progress | None = None
        self._running: list[Activity] = []
        self._line = ""
        self._line_time = 0.0

    @contextmanager
    def show(self, activity: Activity) -> Iterator[None]:
        """Show an activity during the block."""
        if self.has_bars and not self._running:
            self._bars = start_bars(self._console)
        depth = len(self._running)
        self._running.append(activity)
        try:
            self.update()
            yield
        finally:
            # With whatever an exception left running inside.
            del self._running[depth:]
            if not self._running:
                self.stop()

    def stop(self) -> None:
        """Remove the live lines."""
        if self._bars is not None:
            self._bars.stop()
        self._bars = None

    def update(self, log_seconds: float = 0.0) -> None:
        """Show a change; a log shows it only `log_seconds` after its last line."""
        if self._bars is not None:
            self._update_bars(self._bars)
        elif not self.has_bars and time.monotonic() >= self._line_time + log_seconds:
            self._print_line()

    def _update_bars(self, bars: Progress) -> None:
        # Bars are in the order of the running activities, and take over each other's place.
        for task in bars.task_ids[len(self._running) :]:
            bars.remove_task(task)
        for index, activity in enumerate(self._running):
            label = activity.format_label()
            if index == len(bars.task_ids):
                bars.add_task(label, total=activity.total)
            bars.update(bars.task_ids[index], description=label, completed=activity.num_done)

    def _print_line(self) -> None:
        # Steps inside a stage are hidden.
        shown = [
            activity.format_label()
            for outer, activity in zip([None, *self._running], self._running, strict=False)
            if activity.total is None or outer is None or outer.total is not None
        ]
        line = ": ".join(shown)
        if line != self._line:
            self._line = line
            self._line_time = time.monotonic()
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)


def start_bars(console: Console) -> Progress:
    """Start live lines that disappear at the end."""
    from rich import progress  # a log does not need it

    bars = progress.Progress(
        progress.SpinnerColumn(),
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(24),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        console=console,
        transient=True,
        refresh_per_second=4,
        redirect_stdout=False,
    )
    bars.start()
    return bars


_display: ContextVar[Display | None] = ContextVar("display", default=None)
_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


@contextmanager
def show_progress(console: Console | None) -> Iterator[None]:
    """Show activities of the block on `console`; None or a quiet one hides them."""
    display = None if console is None or console.quiet else Display(console)
    token = _display.set(display)
    try:
        yield
    finally:
        _display.reset(token)
        if display is not None:
            display.stop()


@contextmanager
def notify_of_stages(listener: Callable[[str], None]) -> Iterator[None]:
    """Call `listener` with the name of each stage that begins during the block."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def stage(name: str) -> AbstractContextManager[None]:
    """Show a stage during the block, and notify the listener."""
    listener = _listener.get()
    display = _display.get()
    if listener is not None:
        listener(name)
    return nullcontext() if display is None else display.show(Activity(name))


def show_preparation(name: str) -> AbstractContextManager[None]:
    """Show a preparation with its stages during the block, on a terminal only."""
    display = _display.get()
    if display is None or not display.has_bars:
        return show_progress(None)
    return display.show(Activity(name))


def track(items: Iterable[T], description: str, total: int | None = None) -> Iterable[T]:
    """Show the progress while iterating over `items`, `total` if they have no length."""
    display = _display.get()
    total = len(items) if isinstance(items, Sized) else total
    if display is None or not total:
        return items
    return count_items(items, Activity(description, total), display)


def count_items(items: Iterable[T], activity: Activity, display: Display) -> Iterator[T]:
    """Count items on a display while iterating over them."""
    with display.show(activity):
        for item in items:
            yield item
            activity.num_done += 1
            display.update(LOG_SECONDS)
