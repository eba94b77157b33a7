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
REFRESHES_PER_SECOND = 4
BAR_WIDTH = 24
OVERDUE_FRACTION = 0.1
"""Remaining share of the elapsed time if a stage takes longer than expected."""


@dataclass(eq=False)
class Activity:
    """A running stage, or a number of counted steps."""

    name: str
    total: int | None = None
    """Number of steps; None for a stage."""
    num_done: int = 0
    is_preparation: bool = False
    """True if a log shows it only if it takes long."""
    start_time: float = field(default_factory=lambda: time.monotonic())
    last_step_time: float = field(default_factory=lambda: time.monotonic())
    """Time of the last finished step, in seconds."""

    def format_label(self) -> str:
        """Return the name, with the number of the current step."""
        if self.total is None:
            return self.name
        return f"{self.name} {min(self.num_done + 1, self.total)} of {self.total}"

    def count_step(self) -> None:
        """Count a finished step."""
        self.num_done, self.last_step_time = self.num_done + 1, time.monotonic()

    def estimate_left(self, now: float, expected: float | None = None) -> float | None:
        """Estimate the remaining seconds from the finished steps or from `expected`."""
        if self.total is not None and self.num_done > 0:
            each = (self.last_step_time - self.start_time) / self.num_done
            return max(each * (self.total - self.num_done) - (now - self.last_step_time), 0.0)
        spent = now - self.start_time
        return None if expected is None else max(expected - spent, OVERDUE_FRACTION * spent)


@dataclass
class Work:
    """All running activities, the outermost first, and the expected stages."""

    running: list[Activity] = field(default_factory=list)
    expected: Sequence[tuple[str, float]] = ()
    """Expected stages in order, with seconds each."""
    is_timed: bool = True
    """True if these are seconds; otherwise relative times."""
    num_finished: int = 0
    current: Activity | None = None
    start_time: float = 0.0
    """Start of the expected stages, in seconds."""
    pace: float = 1.0
    """Measured relative to expected time of the finished stages."""
    max_fraction: float = 0.0
    """Largest fraction shown so far; it never decreases."""

    def expect(self, expected: Sequence[tuple[str, float]], is_timed: bool = True) -> None:
        """Set the expected stages."""
        self.is_timed = is_timed
        self.expected, self.num_finished, self.current = expected, 0, None
        self.start_time, self.pace, self.max_fraction = time.monotonic(), 1.0, 0.0

    def begin(self, activity: Activity) -> None:
        """Start an activity inside the running ones."""
        self.running.append(activity)
        names = [name for name, _ in self.expected]
        if self.current is None and activity.name in names[self.num_finished :]:
            self.num_finished = names.index(activity.name, self.num_finished)
            self.current = activity

    def end(self, activity: Activity) -> None:
        """End an activity and all inside it."""
        if activity not in self.running:
            return
        del self.running[self.running.index(activity) :]
        if activity is self.current:
            self.num_finished, self.current = self.num_finished + 1, None
            behind = sum(seconds for _, seconds in self.expected[: self.num_finished])
            self.pace = (time.monotonic() - self.start_time) / behind

    def describe(self) -> str:
        """Describe the running activities. Steps inside a stage are hidden."""
        return ": ".join(
            activity.format_label()
            for index, activity in enumerate(self.running)
            if activity.total is None or index == 0 or self.running[index - 1].total is not None
        )

    def find_counted(self) -> Activity | None:
        """Return the outermost running activity with counted steps."""
        return find_outermost_counted(self.running)

    def measure_elapsed(self) -> float:
        """Return the seconds since the start of the expected stages or the outermost activity."""
        begun = self.start_time if self.expected else self.running[0].start_time
        return time.monotonic() - begun

    def estimate_left(self) -> float | None:
        """Estimate the remaining seconds of everything, or return None if unknown."""
        now = time.monotonic()
        if not (self.expected and self.is_timed):
            counted = self.find_counted()
            return None if counted is None else counted.estimate_left(now)
        ahead = [self.pace * seconds for _, seconds in self.expected[self.num_finished :]]
        if self.current is not None:
            ahead[0] = self.current.estimate_left(now, ahead[0]) or 0.0
        return sum(ahead, 0.0)

    def estimate_fraction(self) -> float | None:
        """Estimate the finished fraction of everything, or return None if unknown."""
        if not self.expected:
            return compute_counted_fraction(self.running)
        if self.is_timed:
            spent, left = self.measure_elapsed(), self.estimate_left() or 0.0
            share = spent / max(spent + left, 1e-9)
        else:
            share = self.compute_stage_fraction()
        self.max_fraction = max(self.max_fraction, share)
        return self.max_fraction

    def compute_stage_fraction(self) -> float:
        """Return the finished fraction of the expected stages, with steps inside."""
        seconds = [seconds for _, seconds in self.expected]
        done = sum(seconds[: self.num_finished])
        if self.current is not None:
            inside = self.running[self.running.index(self.current) :]
            done += seconds[self.num_finished] * (compute_counted_fraction(inside) or 0.0)
        return done / max(sum(seconds), 1e-9)

    def format_line(self) -> str:
        """Format everything as one line."""
        left, share, spent = self.estimate_left(), self.estimate_fraction(), self.measure_elapsed()
        parts = [
            *([] if share is None else [f"{share:.0%}"]),
            *([f"{format_seconds(spent)} so far"] if spent >= 1 else []),
            *([] if left is None else [f"about {format_seconds(left)} left"]),
        ]
        return ": ".join([self.describe(), *([", ".join(parts)] if parts else [])])


def find_outermost_counted(activities: Sequence[Activity]) -> Activity | None:
    """Return the outermost activity with counted steps, if any."""
    return next((a for a in activities if a.total is not None), None)


def compute_counted_fraction(activities: Sequence[Activity]) -> float | None:
    """Return the finished fraction of its steps, if any."""
    counted = find_outermost_counted(activities)
    return None if counted is None else counted.num_done / max(counted.total or 0, 1)


@runtime_checkable
class Display(Protocol):
    """Display of the running activities."""

    def start(self) -> None:
        """Begin to show activities."""

    def update(self) -> None:
        """Show a change."""

    def stop(self) -> None:
        """End the display."""


class LiveLine:
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
            refresh_per_second=REFRESHES_PER_SECOND,
            redirect_stdout=False,
        )

    def start(self) -> None:
        """Begin to show activities."""
        self._live.start()

    def update(self) -> None:
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
        if not work.running:
            return row
        left, share = work.estimate_left(), work.estimate_fraction()
        # On a narrow terminal only the name is shortened.
        name = Text(work.describe(), no_wrap=True, overflow="ellipsis")
        cells: list[RenderableType] = [self._spinner, name]
        if share is not None:
            cells += [ProgressBar(1.0, share, BAR_WIDTH), f"{share:.0%}"]
        cells.append(format_seconds(work.measure_elapsed()))
        if left is not None:
            cells.append(f"about {format_seconds(left)} left")
        for cell in cells:
            row.add_column(no_wrap=cell is not name)
        row.add_row(*cells)
        return row


class LogLines:
    """Log lines: one per stage, and one every `LOG_SECONDS`."""

    def __init__(self, console: Console, work: Work) -> None:
        self._console, self._work = console, work
        self._said, self._when = "", 0.0
        self._over = Event()

    def start(self) -> None:
        """Begin to show activities."""
        self._over, self._when = Event(), time.monotonic()
        Thread(target=self._repeat, args=(self._over,), daemon=True).start()

    def update(self) -> None:
        """Print a new stage."""
        description = self._work.describe()
        if description != self._said and not any(a.is_preparation for a in self._work.running):
            self._said = description
            self._print()

    def stop(self) -> None:
        """End the display."""
        self._over.set()

    def _print(self) -> None:
        self._when = time.monotonic()
        sentence = self._work.format_line()
        self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)

    def _repeat(self, over: Event) -> None:
        while not over.wait(max(self._when + LOG_SECONDS - time.monotonic(), 0.01)):
            if time.monotonic() >= self._when + LOG_SECONDS and self._work.running:
                self._print()


@dataclass(frozen=True)
class ProgressDisplay:
    """Running activities and their display."""

    console: Console
    work: Work
    display: Display

    @contextmanager
    def run_activity(self, activity: Activity) -> Iterator[None]:
        """Show an activity during the block."""
        outermost = not self.work.running
        self.work.begin(activity)
        try:
            if outermost:
                self.display.start()
            self.display.update()
            yield
        finally:
            self.work.end(activity)
            if not self.work.running:
                self.display.stop()


_shown: ContextVar[ProgressDisplay | None] = ContextVar("shown", default=None)
_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


@contextmanager
def show_progress(console: Console | None) -> Iterator[None]:
    """Show activities of the block on `console`; None hides them."""
    shown = None if console is None else make_progress(console)
    token = _shown.set(shown)
    try:
        yield
    finally:
        _shown.reset(token)
        if shown is not None:
            shown.work.running.clear()
            shown.display.stop()


@contextmanager
def notify_of_stages(listener: Callable[[str], None]) -> Iterator[None]:
    """Call `listener` with the name of each stage that begins during the block."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def make_progress(console: Console) -> ProgressDisplay:
    """Choose the display for a console."""
    work, lives = Work(), console.is_terminal and not console.is_dumb_terminal
    return ProgressDisplay(
        console, work, LiveLine(console, work) if lives else LogLines(console, work)
    )


def stage(name: str) -> AbstractContextManager[None]:
    """Show a stage during the block, and notify the listener."""
    listener = _listener.get()
    if listener is not None:
        listener(name)
    return show_activity(Activity(name))


def show_preparation(name: str) -> AbstractContextManager[None]:
    """Show a preparation during the block; a log shows it only if it takes long."""
    return show_activity(Activity(name, is_preparation=True))


@contextmanager
def show_activity(activity: Activity) -> Iterator[None]:
    """Show an activity during the block, if a display is active."""
    shown = _shown.get()
    if shown is None:
        yield
        return
    with shown.run_activity(activity):
        yield


def track(items: Sequence[T], description: str) -> Iterable[T]:
    """Show the progress while iterating over items."""
    shown = _shown.get()
    return items if shown is None else count_items(items, description, shown)


def count_items(items: Sequence[T], description: str, shown: ProgressDisplay) -> Iterator[T]:
    """Count items on a display while iterating over them."""
    activity = Activity(description, len(items))
    with shown.run_activity(activity):
        for item in items:
            yield item
            activity.count_step()


@contextmanager
def expect_stages(seconds: Sequence[tuple[str, float]], is_timed: bool = True) -> Iterator[None]:
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


def format_seconds(seconds: float) -> str:
    """Format a duration: `8 s`, `2 min 5 s`, `1 h 20 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
