"""Progress: live lines on a terminal or in a notebook, otherwise log lines; on stderr."""

from __future__ import annotations

import io
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, Task, TaskID

T = TypeVar("T")

LOG_SECONDS = 5.0
"""Most seconds without a line in a log while a stage runs, and fewest between counted steps."""
NOTEBOOK_SECONDS = 0.25
"""Fewest seconds between two pictures of the bars in a notebook."""
NOTEBOOK_WIDTH = 90
"""Width of the bars in a notebook, in characters."""


class Display:
    """The running activities on a console: tasks of rich, the outermost first.

    On a terminal rich shows them. In a log it only keeps them, for the lines that are printed: one
    as each begins, and for a stage that takes long one every `LOG_SECONDS`, from a thread.
    """

    def __init__(self, console: Console) -> None:
        self.has_bars = console.is_terminal and not console.is_dumb_terminal
        self._console = console
        self._running = make_bars(console)
        # The last line of a log and its time: a line is not printed twice, nor steps too often.
        self._line = ""
        self._line_time = time.monotonic()
        # The thread that prints a line where a log is silent for long, and what ends it.
        self._pulse: threading.Thread | None = None
        self._ended = threading.Event()

    def start_pulse(self) -> None:
        """Begin to print a line where a stage is silent for long, unless there are bars."""
        if self.has_bars:
            return
        # A daemon, so that no error of the command waits for it.
        self._pulse = threading.Thread(target=self._print_silent_stages, daemon=True)
        self._pulse.start()

    @contextmanager
    def show(self, name: str, total: int | None = None) -> Iterator[TaskID]:
        """Show a number of counted steps during the block, or without `total` a stage."""
        if self.has_bars and not self._running.tasks:
            # New ones: if bars are started again, they erase the lines above them.
            self._running = make_bars(self._console)
            self._running.start()
        running = self._running
        task = running.add_task(name, total=total)
        try:
            self._log()
            yield task
        finally:
            # With whatever an exception left running inside.
            ended = [number for number in running.task_ids if number >= task]
            if self.has_bars and ended == running.task_ids:
                # Before the tasks are removed: without any, rich erases a line too many.
                running.stop()
            for number in ended:
                running.remove_task(number)

    def advance(self, task: TaskID) -> None:
        """Count a step; a log shows it only `LOG_SECONDS` after its last line."""
        self._running.advance(task)
        if time.monotonic() >= self._line_time + LOG_SECONDS:
            self._log()

    def stop(self) -> None:
        """Remove the live lines, and end the lines of stages that take long."""
        if self.has_bars:
            self._running.stop()
        if self._pulse is not None:
            self._ended.set()
            self._pulse.join()

    def _print_silent_stages(self) -> None:
        """Print what runs, with the steps inside of stages, where the log is silent for long."""
        period = LOG_SECONDS / 10
        told = self._line_time
        while not self._ended.wait(period):
            now = time.monotonic()
            if now + period < max(told, self._line_time) + LOG_SECONDS:
                continue
            # Counted steps that run no stage print a line as each ends.
            running = self._running.tasks
            if any(task.total is None for task in running):
                line = ": ".join(format_label(task) for task in running)
                seconds = int(running[-1].elapsed or 0)
                self._console.print(f"{line} ({seconds} s)", soft_wrap=True)
                told = now

    def _log(self) -> None:
        """Print the running activities as a line of a log, unless it would be the last one again.

        Steps inside a stage are hidden.
        """
        running = self._running.tasks
        shown = [
            format_label(task)
            for outer, task in zip([None, *running], running, strict=False)
            if task.total is None or outer is None or outer.total is not None
        ]
        line = ": ".join(shown)
        if not self.has_bars and line != self._line:
            self._line = line
            self._line_time = time.monotonic()
            self._console.print(line, soft_wrap=True)


class NotebookDisplay(Display):
    """The running activities below a cell of a notebook, in one place that is emptied at the end.

    rich draws them. Its own live display needs ipywidgets, which few kernels have.
    """

    def __init__(self, console: Console) -> None:
        super().__init__(console)
        self._place: Any = None
        self._drawn = float("-inf")

    def advance(self, task: TaskID) -> None:
        """Count a step; it is drawn `NOTEBOOK_SECONDS` after the last picture at the earliest."""
        self._running.advance(task)
        if time.monotonic() >= self._drawn + NOTEBOOK_SECONDS:
            self._log()

    def stop(self) -> None:
        """Empty the place of the bars."""
        if self._place is not None:
            self._place.update({"text/html": "", "text/plain": ""}, raw=True)

    def _log(self) -> None:
        """Draw the bars anew."""
        from IPython.display import display

        self._drawn = time.monotonic()
        bars = draw_bars(self._running)
        if self._place is None:
            self._place = display(bars, raw=True, display_id=True)
        else:
            self._place.update(bars, raw=True)


def draw_bars(running: Progress) -> dict[str, str]:
    """Draw the bars as HTML, and as text for notebooks that show none."""
    from gscompleter.system.console import make_console

    drawing = make_console(
        record=True, file=io.StringIO(), width=NOTEBOOK_WIDTH, force_jupyter=False
    )
    drawing.print(running.get_renderable())
    html = drawing.export_html(
        inline_styles=True, clear=False, code_format='<pre style="margin:0">{code}</pre>'
    )
    return {"text/html": html, "text/plain": drawing.export_text()}


def make_bars(console: Console) -> Progress:
    """Make live lines that disappear at the end."""
    # Imported by commands that show progress; a library call does without.
    from rich import progress
    from rich.text import Text

    class LabelColumn(progress.ProgressColumn):
        """The name of an activity, with the number of the current step."""

        def render(self, task: Task) -> Text:
            return Text(format_label(task))

    return progress.Progress(
        progress.SpinnerColumn(),
        LabelColumn(),
        progress.BarColumn(24),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        console=console,
        transient=True,
        refresh_per_second=4,
        redirect_stdout=False,
    )


def format_label(task: Task) -> str:
    """Return the name of an activity, with the number of the current step."""
    if task.total is None:
        return task.description
    return f"{task.description} {min(task.completed + 1, task.total)} of {task.total}"


_display: ContextVar[Display | None] = ContextVar("display", default=None)
_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


@contextmanager
def show_progress(console: Console | None) -> Iterator[None]:
    """Show activities of the block on `console`; None or a quiet one hides them."""
    display = None if console is None or console.quiet else Display(console)
    token = _display.set(display)
    if display is not None:
        display.start_pulse()
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


@contextmanager
def show_in_notebook() -> Iterator[None]:
    """Show activities of the block below the cell of a notebook that runs it.

    Elsewhere, and inside of a call that shows its progress already, this does nothing.
    """
    if _display.get() is not None or not is_notebook():
        yield
        return
    from gscompleter.system.console import make_console

    display = NotebookDisplay(make_console(file=io.StringIO(), force_jupyter=False))
    token = _display.set(display)
    try:
        yield
    finally:
        _display.reset(token)
        display.stop()


def is_notebook() -> bool:
    """Check whether the kernel of a notebook runs this process, as rich does."""
    # A process that has not imported IPython is none, and need not import rich to ask.
    if "IPython" not in sys.modules:
        return False
    from gscompleter.system.console import make_console

    return make_console().is_jupyter


def stage(name: str) -> AbstractContextManager[object]:
    """Show a stage during the block, and notify the listener."""
    listener = _listener.get()
    display = _display.get()
    if listener is not None:
        listener(name)
    return nullcontext() if display is None else display.show(name)


def show_preparation(name: str) -> AbstractContextManager[object]:
    """Show a preparation with its stages during the block, on a terminal only."""
    display = _display.get()
    if display is None or not display.has_bars:
        return show_progress(None)
    return display.show(name)


def track(
    items: Iterable[T], description: str, total: int | None = None, has_lines: bool = True
) -> Iterable[T]:
    """Show the progress while iterating over `items`, `total` if they have no length.

    `has_lines` is False if the caller prints a line for each item itself; then only bars are shown.
    """
    display = _display.get()
    total = len(items) if isinstance(items, Sized) else total
    if display is None or not total or not (has_lines or display.has_bars):
        return items
    return count_items(items, description, total, display)


def count_items(items: Iterable[T], description: str, total: int, display: Display) -> Iterator[T]:
    """Count items on a display while iterating over them."""
    with display.show(description, total) as task:
        for item in items:
            yield item
            display.advance(task)
