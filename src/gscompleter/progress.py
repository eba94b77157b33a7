"""Progress on stderr: a live line on a terminal, otherwise log lines."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import Event, Thread
from typing import TYPE_CHECKING, Protocol, TypeVar, runtime_checkable

from rich.console import Console

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

T = TypeVar("T")

LOG_SECONDS = 10.0
"""Seconds between log lines of a long stage."""
REFRESHES = 4
BAR_WIDTH = 24
OVERDUE = 0.1
"""Remaining share of the elapsed time if a stage takes longer than expected."""


@dataclass(eq=False)
class Activity:
    """A running stage, or a number of counted steps."""

    name: str
    total: int | None = None
    """Number of steps; None for a stage."""
    done: int = 0
    prepares: bool = False
    """True if a log shows it only if it takes long."""
    begun: float = field(default_factory=lambda: time.monotonic())
    last: float = field(default_factory=lambda: time.monotonic())
    """Time of the last finished step, in seconds."""

    def label(self) -> str:
        """Return the name, with the number of the current step."""
        if self.total is None:
            return self.name
        return f"{self.name} {min(self.done + 1, self.total)} of {self.total}"

    def stepped(self) -> None:
        """Count a finished step."""
        self.done, self.last = self.done + 1, time.monotonic()

    def left(self, now: float, expected: float | None = None) -> float | None:
        """Estimate the remaining seconds from the finished steps or from `expected`."""
        if self.total is not None and self.done > 0:
            each = (self.last - self.begun) / self.done
            return max(each * (self.total - self.done) - (now - self.last), 0.0)
        spent = now - self.begun
        return None if expected is None else max(expected - spent, OVERDUE * spent)


@dataclass
class Work:
    """All running activities, the outermost first, and the expected stages."""

    going: list[Activity] = field(default_factory=list)
    expected: Sequence[tuple[str, float]] = ()
    """Expected stages in order, with seconds each."""
    is_timed: bool = True
    """True if these are seconds; otherwise relative times."""
    position: int = 0
    planned: Activity | None = None
    begun: float = 0.0
    """Start of the expected stages, in seconds."""
    pace: float = 1.0
    """Measured relative to expected time of the finished stages."""
    reached: float = 0.0
    """Largest fraction shown so far; it never decreases."""

    def expect(self, expected: Sequence[tuple[str, float]], is_timed: bool = True) -> None:
        """Set the expected stages."""
        self.is_timed = is_timed
        self.expected, self.position, self.planned = expected, 0, None
        self.begun, self.pace, self.reached = time.monotonic(), 1.0, 0.0

    def begin(self, activity: Activity) -> None:
        """Start an activity inside the running ones."""
        self.going.append(activity)
        names = [name for name, _ in self.expected]
        if self.planned is None and activity.name in names[self.position :]:
            self.position = names.index(activity.name, self.position)
            self.planned = activity

    def end(self, activity: Activity) -> None:
        """End an activity and all inside it."""
        if activity not in self.going:
            return
        del self.going[self.going.index(activity) :]
        if activity is self.planned:
            self.position, self.planned = self.position + 1, None
            behind = sum(seconds for _, seconds in self.expected[: self.position])
            self.pace = (time.monotonic() - self.begun) / behind

    def description(self) -> str:
        """Describe the running activities. Steps inside a stage are hidden."""
        return ": ".join(
            activity.label()
            for index, activity in enumerate(self.going)
            if activity.total is None or index == 0 or self.going[index - 1].total is not None
        )

    def counted(self) -> Activity | None:
        """Return the outermost running activity with counted steps."""
        return outermost_counted(self.going)

    def spent(self) -> float:
        """Return the seconds since the start of the expected stages or the outermost activity."""
        begun = self.begun if self.expected else self.going[0].begun
        return time.monotonic() - begun

    def left(self) -> float | None:
        """Estimate the remaining seconds of everything, or return None if unknown."""
        now = time.monotonic()
        if not (self.expected and self.is_timed):
            counted = self.counted()
            return None if counted is None else counted.left(now)
        ahead = [self.pace * seconds for _, seconds in self.expected[self.position :]]
        if self.planned is not None:
            ahead[0] = self.planned.left(now, ahead[0]) or 0.0
        return sum(ahead, 0.0)

    def share(self) -> float | None:
        """Estimate the finished fraction of everything, or return None if unknown."""
        if not self.expected:
            return counted_share(self.going)
        if self.is_timed:
            spent, left = self.spent(), self.left() or 0.0
            share = spent / max(spent + left, 1e-9)
        else:
            share = self.share_of_stages()
        self.reached = max(self.reached, share)
        return self.reached

    def share_of_stages(self) -> float:
        """Return the finished fraction of the expected stages, with steps inside."""
        seconds = [seconds for _, seconds in self.expected]
        done = sum(seconds[: self.position])
        if self.planned is not None:
            inside = self.going[self.going.index(self.planned) :]
            done += seconds[self.position] * (counted_share(inside) or 0.0)
        return done / max(sum(seconds), 1e-9)

    def sentence(self) -> str:
        """Format everything as one line."""
        left, share, spent = self.left(), self.share(), self.spent()
        parts = [
            *([] if share is None else [f"{share:.0%}"]),
            *([f"{in_words(spent)} so far"] if spent >= 1 else []),
            *([] if left is None else [f"about {in_words(left)} left"]),
        ]
        return ": ".join([self.description(), *([", ".join(parts)] if parts else [])])


def outermost_counted(activities: Sequence[Activity]) -> Activity | None:
    """Return the outermost activity with counted steps, if any."""
    return next((a for a in activities if a.total is not None), None)


def counted_share(activities: Sequence[Activity]) -> float | None:
    """Return the finished fraction of its steps, if any."""
    counted = outermost_counted(activities)
    return None if counted is None else counted.done / max(counted.total or 0, 1)


@runtime_checkable
class Display(Protocol):
    """Display of the running activities."""

    def start(self) -> None:
        """Begin to show activities."""

    def changed(self) -> None:
        """Show a change."""

    def stop(self) -> None:
        """End the display."""


class Line:
    """A live line on a terminal, which disappears at the end."""

    def __init__(self, console: Console, work: Work) -> None:
        # Imported here because a log does not need it.
        from rich.live import Live
        from rich.spinner import Spinner

        self._work, self._spinner = work, Spinner("dots")
        self._live = Live(
            get_renderable=self._row,
            console=console,
            transient=True,
            refresh_per_second=REFRESHES,
            redirect_stdout=False,
        )

    def start(self) -> None:
        """Begin to show activities."""
        self._live.start()

    def changed(self) -> None:
        """Show a change."""
        self._live.refresh()

    def stop(self) -> None:
        """End the display."""
        self._live.stop()

    def _row(self) -> Table:
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        row, work = Table.grid(padding=(0, 1)), self._work
        if not work.going:
            return row
        left, share = work.left(), work.share()
        # On a narrow terminal only the name is shortened.
        name = Text(work.description(), no_wrap=True, overflow="ellipsis")
        cells: list[RenderableType] = [self._spinner, name]
        if share is not None:
            cells += [ProgressBar(1.0, share, BAR_WIDTH), f"{share:.0%}"]
        cells.append(in_words(work.spent()))
        if left is not None:
            cells.append(f"about {in_words(left)} left")
        for cell in cells:
            row.add_column(no_wrap=cell is not name)
        row.add_row(*cells)
        return row


class Log:
    """Log lines: one per stage, and one every `LOG_SECONDS`."""

    def __init__(self, console: Console, work: Work) -> None:
        self._console, self._work = console, work
        self._said, self._when = "", 0.0
        self._over = Event()

    def start(self) -> None:
        """Begin to show activities."""
        self._over, self._when = Event(), time.monotonic()
        Thread(target=self._repeat, args=(self._over,), daemon=True).start()

    def changed(self) -> None:
        """Print a new stage."""
        description = self._work.description()
        if description != self._said and not any(a.prepares for a in self._work.going):
            self._said = description
            self._print()

    def stop(self) -> None:
        """End the display."""
        self._over.set()

    def _print(self) -> None:
        self._when = time.monotonic()
        sentence = self._work.sentence()
        self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)

    def _repeat(self, over: Event) -> None:
        while not over.wait(max(self._when + LOG_SECONDS - time.monotonic(), 0.01)):
            if time.monotonic() >= self._when + LOG_SECONDS and self._work.going:
                self._print()


@dataclass(frozen=True)
class Shown:
    """Running activities and their display."""

    console: Console
    work: Work
    display: Display

    @contextmanager
    def doing(self, activity: Activity) -> Iterator[None]:
        """Show an activity during the block."""
        outermost = not self.work.going
        self.work.begin(activity)
        try:
            if outermost:
                self.display.start()
            self.display.changed()
            yield
        finally:
            self.work.end(activity)
            if not self.work.going:
                self.display.stop()


_shown: ContextVar[Shown | None] = ContextVar("shown", default=None)
_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


@contextmanager
def shown_on(console: Console | None) -> Iterator[None]:
    """Show activities of the block on `console`; None hides them."""
    shown = None if console is None else on_console(console)
    token = _shown.set(shown)
    try:
        yield
    finally:
        _shown.reset(token)
        if shown is not None:
            shown.work.going.clear()
            shown.display.stop()


@contextmanager
def stages_heard_by(listener: Callable[[str], None]) -> Iterator[None]:
    """Call `listener` with the name of each stage that begins during the block."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def on_console(console: Console) -> Shown:
    """Choose the display for a console."""
    work, lives = Work(), console.is_terminal and not console.is_dumb_terminal
    return Shown(console, work, Line(console, work) if lives else Log(console, work))


def stage(name: str) -> AbstractContextManager[None]:
    """Show a stage during the block, and notify the listener."""
    listener = _listener.get()
    if listener is not None:
        listener(name)
    return going_on(Activity(name))


def preparing(name: str) -> AbstractContextManager[None]:
    """Show a preparation during the block; a log shows it only if it takes long."""
    return going_on(Activity(name, prepares=True))


@contextmanager
def going_on(activity: Activity) -> Iterator[None]:
    """Show an activity during the block, if a display is active."""
    shown = _shown.get()
    if shown is None:
        yield
        return
    with shown.doing(activity):
        yield


def track(items: Sequence[T], description: str) -> Iterable[T]:
    """Show the progress while iterating over items."""
    shown = _shown.get()
    return items if shown is None else counted(items, description, shown)


def counted(items: Sequence[T], description: str, shown: Shown) -> Iterator[T]:
    """Count items on a display while iterating over them."""
    activity = Activity(description, len(items))
    with shown.doing(activity):
        for item in items:
            yield item
            activity.stepped()


@contextmanager
def expecting(seconds: Sequence[tuple[str, float]], is_timed: bool = True) -> Iterator[None]:
    """Set the expected stages of the block, to estimate the remaining time.

    Args:
        seconds: Names of stages or counted steps in order, with seconds each. The times of finished
            stages scale the others. Empty if unknown.
        is_timed: True if these are seconds; otherwise relative times, which yield only the finished
            fraction.
    """
    shown = _shown.get()
    if shown is not None:
        shown.work.expect(seconds, is_timed)
    try:
        yield
    finally:
        if shown is not None:
            shown.work.expect(())


def in_words(seconds: float) -> str:
    """Format a duration: `8 s`, `2 min 5 s`, `1 h 20 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
