"""The scene of a session is opened as `complete` does, and written as its result."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.shared_options import DEFAULT_NUM_TARGETS, CompletingOptions
from gscompleter.apps.completing.complete import write_done
from gscompleter.apps.completing.preparation import Prepared, prepare_completion
from gscompleter.apps.inputs.describing import describe_opening, print_lines
from gscompleter.apps.inputs.task import Target
from gscompleter.apps.live.session import Session
from gscompleter.apps.live.strokes import STROKES, Began, describe_beginning, write_strokes
from gscompleter.apps.report.results import COMMAND, RESULTS
from gscompleter.data.scene import write_cameras
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import check_output, open_output_folder
from gscompleter.system.files.writing import TARGETS_FILE

LIVE_RESULTS = (*RESULTS, *STROKES)
"""Globs of the files that a session may write."""


def prepare(options: CompletingOptions, console: Console) -> Prepared:
    """Open the scene as `complete` does."""
    check_output(options.out, options.overwrite)
    ready = prepare_completion(make_complete_options(options), console)
    print_lines(console, *describe_opening(ready.opened, ready.task))

    # What the session chose is recorded in summary.json as options of `complete`: the context, and
    # the file into which the cameras of the session are saved.
    target = (str(options.out / TARGETS_FILE),)
    complete_options = replace(ready.options, context=ready.task.context_frames, target=target)
    return replace(ready, options=complete_options)


def make_complete_options(options: CompletingOptions) -> CompleteOptions:
    """Convert the options to those of `complete`."""
    shared = {field.name: getattr(options, field.name) for field in fields(CompletingOptions)}
    # A session begins wherever the splat looks well, if nothing tells where its cameras were.
    return CompleteOptions(**shared, auto=DEFAULT_NUM_TARGETS)


def begin_session(ready: Prepared) -> Session:
    """Start the session."""
    return Session(
        ready.completer,
        (ready.begin(),),
        ready.task.frame,
        ready.opened.photographs.origin,
        ready.opened.request.resolution,
        splat_origin=ready.task.origin,
    )


def describe_began(ready: Prepared) -> Began:
    """Describe what a session began with, so that it can begin again."""
    # Cameras that were found are found again.
    context = ready.task.context_frames if ready.opened.has_numbered_frames else None
    return describe_beginning(ready.options, context)


def save_session(ready: Prepared, session: Session) -> str:
    """Write the results of `complete`, in place of those saved before, and return a sentence."""
    # The first completion of a session is the context alone.
    if len(session.completions) == 1:
        raise InputError("There is nothing to save; complete or repair something first.")
    # Whether it may be replaced was decided when the session began.
    with open_output_folder(ready.options.out, overwrite=True, command=COMMAND) as folder:
        summary = write_session(folder, ready, session)
    return f"Saved in {quote_value(ready.options.out)}. {summary['outcome']['headline']}"


def write_session(folder: Path, ready: Prepared, session: Session) -> dict[str, Any]:
    """Write the results of `complete` and the steps of a session, and return the summary."""
    targets = [Target(result.target) for result in session.latest.targets]
    with_targets = replace(ready, task=replace(ready.task, targets=targets))
    summary = write_done(folder, with_targets, session.latest, "live")
    if session.cameras:
        write_cameras(folder / TARGETS_FILE, session.cameras)
    write_strokes(folder, session, describe_began(ready))
    return summary
