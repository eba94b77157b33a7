"""A saved session, done again without a browser."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from gscompleter.apps.command_line.exit_codes import DONE
from gscompleter.apps.commands.repair import RepairOptions
from gscompleter.apps.completing.printing import answer_completion
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.live.serving import LIVE_RESULTS, begin_session, prepare, write_session
from gscompleter.apps.live.session import Session, Step, apply_step
from gscompleter.apps.live.strokes import STROKES_FILE, StrokesFile, read_steps, read_strokes
from gscompleter.apps.report.results import COMMAND
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.progress import show_progress, track


def replay_strokes(options: RepairOptions, strokes: Path) -> int:
    """Do the steps of a `strokes.json` again, write the result, and return the exit code."""
    path = strokes / STROKES_FILE if os.path.isdir(strokes) else strokes
    saved = read_strokes(path)
    steps = read_steps(saved, path.parent)
    options = add_saved_options(options, saved)
    console = make_console(stderr=True, quiet=options.quiet)
    with (
        show_progress(console),
        reserve_output(options.out, options.overwrite, COMMAND, LIVE_RESULTS) as output,
    ):
        print_lines(console, *output.describe_others())
        ready = prepare(options, console)
        session = begin_session(ready)
        for number, step in enumerate(track(steps, "steps"), start=1):
            session = replay_step(session, step, number, console)
        if not session.steps:
            raise InputError("No step of the session changes the scene; nothing is written.")
        with output.write() as folder:
            write_session(folder, ready, session)
    answer_completion(ready.options)
    return DONE


def replay_step(session: Session, step: Step, number: int, console: Console) -> Session:
    """Do one step again; what is wrong with it is told with its number, from 1."""
    try:
        changed, text = apply_step(session, step)
    except InputError as error:
        raise InputError(f"Step {number} ({step.action}): {error}") from error
    if changed is session:
        print_lines(console, f"Step {number} ({step.action}) changes nothing: {text}")
    return changed


def add_saved_options(options: RepairOptions, saved: StrokesFile) -> RepairOptions:
    """Return the options with those of the session where they are not given."""
    given = {name: getattr(options, name) for name in ("resolution", "near", "far", "context")}
    missing = {name: getattr(saved, name) for name, value in given.items() if value is None}
    return replace(options, **missing)
