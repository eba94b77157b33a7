"""Steps of a session, done again: without a browser, or before a session goes on."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

from gscompleter.apps.command_line.exit_codes import DONE
from gscompleter.apps.completing.printing import answer_completion
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.live.opening import SessionRequest
from gscompleter.apps.live.saving import (
    LIVE_RESULTS,
    begin_session,
    prepare_session,
    write_session,
)
from gscompleter.apps.live.session import Session, SessionStep, apply_step, undo_step
from gscompleter.apps.report.results import COMPLETE_COMMAND
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.progress import show_progress, track


def replay_session(request: SessionRequest) -> int:
    """Do the steps of a session again, write the result, and return the exit code.

    Steps that were undone are no part of the result, and are left out.
    """
    results = request.completion.results
    console = make_console(stderr=True, quiet=results.answer.quiet)
    with (
        show_progress(console),
        reserve_output(results.out, results.overwrite, COMPLETE_COMMAND, LIVE_RESULTS) as output,
    ):
        print_lines(console, *request.notes, *output.describe_others())
        prepared = prepare_session(request, console)
        session = replay_steps(begin_session(prepared), request.steps, (), console)
        if not session.steps:
            raise InputError("No step of the session changes the scene; nothing is written.")
        with output.write() as folder:
            write_session(folder, prepared, session)
    answer_completion(results)
    return DONE


def replay_steps(
    session: Session, steps: Sequence[SessionStep], undone: Sequence[SessionStep], console: Console
) -> Session:
    """Do steps again, and those that were undone, which can then be redone at once.

    Of the latter the next to be redone comes first.
    """
    with_steps = session
    for number, step in enumerate(track([*steps, *undone], "steps"), start=1):
        session = replay_step(session, step, number, console)
        if number <= len(steps):
            with_steps = session
    # A redo puts back the scene after a step, which only doing that step makes.
    while len(session.steps) > len(with_steps.steps):
        session = undo_step(session)
    return session


def replay_step(session: Session, step: SessionStep, number: int, console: Console) -> Session:
    """Do one step again; what is wrong with it is told with its number, from 1.

    A step that changes nothing leaves the session as it is, and is told, too.
    """
    try:
        changed, text = apply_step(session, step)
    except InputError as error:
        raise InputError(f"Step {number} ({step.action}): {error}") from error
    if changed is session:
        print_lines(console, f"Step {number} ({step.action}) changes nothing: {text}")
    return changed
