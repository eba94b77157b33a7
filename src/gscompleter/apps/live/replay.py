"""Steps of a session, done again: without a browser, or before a session goes on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from rich.console import Console

from gscompleter.apps.command_line.exit_codes import DONE
from gscompleter.apps.commands.repair import RepairOptions
from gscompleter.apps.commands.shared_options import CompletingOptions
from gscompleter.apps.completing.printing import answer_completion
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.live.saving import LIVE_RESULTS, begin_session, prepare, write_session
from gscompleter.apps.live.session import Session, Step, apply_step, undo_step
from gscompleter.apps.live.strokes import (
    ADVICE,
    OF_STROKES,
    StrokesFile,
    find_strokes_file,
    read_steps,
    read_strokes,
)
from gscompleter.apps.report.results import COMMAND
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.progress import show_progress, track

Known = TypeVar("Known", bound=CompletingOptions)


def replay_strokes(options: RepairOptions, strokes: Path) -> int:
    """Do the steps of a `strokes.json` again, write the result, and return the exit code."""
    path = find_strokes_file(strokes)
    saved = read_strokes(path)
    if not saved.frames:
        raise InputError(f"{quote_value(path)} has no steps; {ADVICE}.", "strokes")
    steps = read_steps(saved.frames, path.parent)
    options = add_saved_options(options, saved)
    console = make_console(stderr=True, quiet=options.quiet)
    with (
        show_progress(console),
        reserve_output(options.out, options.overwrite, COMMAND, LIVE_RESULTS) as output,
    ):
        print_lines(console, *output.describe_others())
        ready = prepare(options, console)
        session = replay_steps(begin_session(ready), steps, (), console)
        if not session.steps:
            raise InputError("No step of the session changes the scene; nothing is written.")
        with output.write() as folder:
            write_session(folder, ready, session)
    answer_completion(ready.options)
    return DONE


def replay_steps(
    session: Session, steps: Sequence[Step], undone: Sequence[Step], console: Console
) -> Session:
    """Do steps again, and those that were undone, which can then be done again."""
    for number, step in enumerate(track([*steps, *undone], "steps"), start=1):
        if number == len(steps) + 1:
            kept = len(session.steps)
        session = replay_step(session, step, number, console)
    while undone and len(session.steps) > kept:
        session = undo_step(session)
    return session


def replay_step(session: Session, step: Step, number: int, console: Console) -> Session:
    """Do one step again; what is wrong with it is told with its number, from 1."""
    try:
        changed, text = apply_step(session, step)
    except InputError as error:
        raise InputError(f"Step {number} ({step.action}): {error}") from error
    if changed is session:
        print_lines(console, f"Step {number} ({step.action}) changes nothing: {text}")
    return changed


def add_saved_options(options: Known, saved: StrokesFile) -> Known:
    """Return the options with those of the session where they are not given."""
    given = {name: getattr(options, name) for name in OF_STROKES}
    missing = {name: getattr(saved, name) for name, value in given.items() if value is None}
    return replace(options, **missing)
