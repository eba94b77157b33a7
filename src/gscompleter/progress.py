"""What goes on, how far it is and how long it still takes, shown where somebody watches.

The command line turns it on, a library call stays silent.

A terminal has one line that lives, a log a line for each stage and one every few seconds of a long
one. Nothing of it goes to standard output, where the results are.
"""

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
"""After as many seconds a log is told again what goes on."""
REFRESHES = 4
"""How often in a second the line on a terminal is drawn."""
BAR_WIDTH = 24
"""Characters of the bar on a terminal."""
OVERDUE = 0.1
"""What takes longer than was expected takes this share of its time more, until it is done."""


@dataclass(eq=False)
class Activity:
    """Something that goes on: a stage, or as many steps as were counted in advance."""

    name: str
    total: int | None = None
    """How many steps it has; None for a stage."""
    done: int = 0
    """Steps that are done."""
    prepares: bool = False
    """Whether a log hears of it only where it takes long."""
    begun: float = field(default_factory=lambda: time.monotonic())
    last: float = field(default_factory=lambda: time.monotonic())
    """When the last of the steps was done, in seconds."""

    def label(self) -> str:
        """What it is called, and the number of the step."""
        if self.total is None:
            return self.name
        return f"{self.name} {min(self.done + 1, self.total)} of {self.total}"

    def stepped(self) -> None:
        """One more step is done."""
        self.done, self.last = self.done + 1, time.monotonic()

    def left(self, now: float, expected: float | None = None) -> float | None:
        """About how many seconds it still takes: by the steps that are done, or as `expected`."""
        if self.total is not None and self.done > 0:
            each = (self.last - self.begun) / self.done
            return max(each * (self.total - self.done) - (now - self.last), 0.0)
        spent = now - self.begun
        return None if expected is None else max(expected - spent, OVERDUE * spent)


@dataclass
class Work:
    """All that goes on, the outermost first, and what is expected to come."""

    going: list[Activity] = field(default_factory=list)
    expected: Sequence[tuple[str, float]] = ()
    """Stages in their order, and the seconds that each is expected to take."""
    is_timed: bool = True
    """True if these are seconds; else only their ratios count."""
    position: int = 0
    """How many of these are behind."""
    planned: Activity | None = None
    """That of them which goes on."""
    begun: float = 0.0
    """When the first of them began to be expected, in seconds."""
    pace: float = 1.0
    """By how much longer than expected those took that are behind."""
    reached: float = 0.0
    """The largest share of what is expected that was told to be done: it never goes back."""

    def expect(self, expected: Sequence[tuple[str, float]], is_timed: bool = True) -> None:
        """From now on, these stages are expected."""
        self.is_timed = is_timed
        self.expected, self.position, self.planned = expected, 0, None
        self.begun, self.pace, self.reached = time.monotonic(), 1.0, 0.0

    def begin(self, activity: Activity) -> None:
        """`activity` goes on, inside of what goes on already."""
        self.going.append(activity)
        names = [name for name, _ in self.expected]
        if self.planned is None and activity.name in names[self.position :]:
            self.position = names.index(activity.name, self.position)
            self.planned = activity

    def end(self, activity: Activity) -> None:
        """`activity` is over, and whatever went on inside of it."""
        if activity not in self.going:
            return
        del self.going[self.going.index(activity) :]
        if activity is self.planned:
            self.position, self.planned = self.position + 1, None
            behind = sum(seconds for _, seconds in self.expected[: self.position])
            self.pace = (time.monotonic() - self.begun) / behind

    def description(self) -> str:
        """What goes on. Steps inside of a stage are known by its name."""
        return ": ".join(
            activity.label()
            for index, activity in enumerate(self.going)
            if activity.total is None or index == 0 or self.going[index - 1].total is not None
        )

    def counted(self) -> Activity | None:
        """The outermost of what goes on whose steps are counted."""
        return outermost_counted(self.going)

    def spent(self) -> float:
        """Seconds since it began: what was expected, or else the outermost of what goes on."""
        begun = self.begun if self.expected else self.going[0].begun
        return time.monotonic() - begun

    def left(self) -> float | None:
        """About how many seconds all of it still takes; None where nothing tells."""
        now = time.monotonic()
        if not (self.expected and self.is_timed):
            counted = self.counted()
            return None if counted is None else counted.left(now)
        ahead = [self.pace * seconds for _, seconds in self.expected[self.position :]]
        if self.planned is not None:
            ahead[0] = self.planned.left(now, ahead[0]) or 0.0
        return sum(ahead, 0.0)

    def share(self) -> float | None:
        """How much of it is done, from 0 to 1; None where nothing tells."""
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
        """Return the share of the expected stages that is done, counted steps inside included."""
        seconds = [seconds for _, seconds in self.expected]
        done = sum(seconds[: self.position])
        if self.planned is not None:
            inside = self.going[self.going.index(self.planned) :]
            done += seconds[self.position] * (counted_share(inside) or 0.0)
        return done / max(sum(seconds), 1e-9)

    def sentence(self) -> str:
        """All of this in a line."""
        left, share, spent = self.left(), self.share(), self.spent()
        told = [
            *([] if share is None else [f"{share:.0%}"]),
            *([f"{in_words(spent)} so far"] if spent >= 1 else []),
            *([] if left is None else [f"about {in_words(left)} left"]),
        ]
        return ": ".join([self.description(), *([", ".join(told)] if told else [])])


def outermost_counted(activities: Sequence[Activity]) -> Activity | None:
    """Return the outermost of `activities` whose steps are counted; None where there is none."""
    return next((a for a in activities if a.total is not None), None)


def counted_share(activities: Sequence[Activity]) -> float | None:
    """Return the share of its steps that this one has done; None where there is none."""
    counted = outermost_counted(activities)
    return None if counted is None else counted.done / max(counted.total or 0, 1)


@runtime_checkable
class Display(Protocol):
    """Shows what goes on, as long as anything does."""

    def start(self) -> None: ...

    def changed(self) -> None: ...

    def stop(self) -> None: ...


class Line:
    """A line of a terminal that lives until all is done, and leaves nothing behind."""

    def __init__(self, console: Console, work: Work) -> None:
        # Here, so that what shows nothing does not wait for it.
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
        self._live.start()

    def changed(self) -> None:
        self._live.refresh()

    def stop(self) -> None:
        self._live.stop()

    def _row(self) -> Table:
        """The line: what goes on, a bar, the share, the time, and what is left of it."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        row, work = Table.grid(padding=(0, 1)), self._work
        if not work.going:
            return row
        left, share = work.left(), work.share()
        # Alone what goes on may be cut, where the terminal is narrow.
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
    """Lines of a file: one for each stage, and one every `LOG_SECONDS` of a long one."""

    def __init__(self, console: Console, work: Work) -> None:
        self._console, self._work = console, work
        self._said, self._when = "", 0.0
        self._over = Event()

    def start(self) -> None:
        self._over, self._when = Event(), time.monotonic()
        Thread(target=self._repeat, args=(self._over,), daemon=True).start()

    def changed(self) -> None:
        description = self._work.description()
        if description != self._said and not any(a.prepares for a in self._work.going):
            self._said = description
            self._print()

    def stop(self) -> None:
        self._over.set()

    def _print(self) -> None:
        self._when = time.monotonic()
        sentence = self._work.sentence()
        self._console.print(sentence, highlight=False, markup=False, soft_wrap=True)

    def _repeat(self, over: Event) -> None:
        """Say again what goes on, until it is over."""
        while not over.wait(max(self._when + LOG_SECONDS - time.monotonic(), 0.01)):
            if time.monotonic() >= self._when + LOG_SECONDS and self._work.going:
                self._print()


@dataclass(frozen=True)
class Shown:
    """What goes on, and where it is shown."""

    console: Console
    work: Work
    display: Display

    @contextmanager
    def doing(self, activity: Activity) -> Iterator[None]:
        """Show `activity` while it goes on."""
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
    """Show what goes on inside on `console`; None hides it."""
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
    """Let `listener` hear the name of each stage that begins in everything called inside."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def on_console(console: Console) -> Shown:
    """What shows it on a terminal, or in a log."""
    work, lives = Work(), console.is_terminal and not console.is_dumb_terminal
    return Shown(console, work, Line(console, work) if lives else Log(console, work))


def stage(name: str) -> AbstractContextManager[None]:
    """Show that what is called inside goes on, by this name, and let a listener hear of it."""
    listener = _listener.get()
    if listener is not None:
        listener(name)
    return going_on(Activity(name))


def preparing(name: str) -> AbstractContextManager[None]:
    """Show that something is read and checked inside. A log hears of it only where it takes long:
    of wrong input there is a sentence, and nothing else."""
    return going_on(Activity(name, prepares=True))


@contextmanager
def going_on(activity: Activity) -> Iterator[None]:
    """Show `activity` where anything is shown."""
    shown = _shown.get()
    if shown is None:
        yield
        return
    with shown.doing(activity):
        yield


def track(items: Sequence[T], description: str) -> Iterable[T]:
    """`items`, one after the other; it is shown how many are done, and how long the others take."""
    shown = _shown.get()
    return items if shown is None else counted(items, description, shown)


def counted(items: Sequence[T], description: str, shown: Shown) -> Iterator[T]:
    """`items`, counted where they are shown."""
    activity = Activity(description, len(items))
    with shown.doing(activity):
        for item in items:
            yield item
            activity.stepped()


@contextmanager
def expecting(seconds: Sequence[tuple[str, float]], is_timed: bool = True) -> Iterator[None]:
    """Tell by the stages that are to come how much is done, and how long all of them take.

    Args:
        seconds: By their names, the stages or counted steps that follow inside, in their order,
            and about how many seconds each takes; one that is left out takes none. Once some are
            over, the others are taken to be as much faster or slower. Empty where nothing tells.
        is_timed: Whether these are seconds. Else only their ratios count, for the share that is
            done, and counted steps alone show how long it takes.
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
    """A time as one says it: `8 s`, `2 min 5 s`, `1 h 20 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
