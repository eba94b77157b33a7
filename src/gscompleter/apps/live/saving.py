"""The scene of a session is opened as `complete` does, and written as its result."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from gscompleter.apps.completing.complete import write_done
from gscompleter.apps.completing.preparation import prepare_completion
from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.inputs.describing import describe_opening, print_lines
from gscompleter.apps.inputs.task import Target
from gscompleter.apps.live.opening import SessionRequest
from gscompleter.apps.live.session import Session
from gscompleter.apps.live.strokes import STROKES, SessionStart, write_strokes
from gscompleter.apps.report.results import COMPLETE_COMMAND, COMPLETION_RESULTS
from gscompleter.apps.requests.completion import TargetRequest
from gscompleter.data.scene import write_cameras
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import check_output, open_output_folder
from gscompleter.system.files.reading import hash_file
from gscompleter.system.files.result_names import TARGETS_FILE

LIVE_RESULTS = (*COMPLETION_RESULTS, *STROKES)
"""Globs of the files that a session may write."""


@dataclass(frozen=True)
class PreparedSession:
    """Everything that is loaded before the first step."""

    request: SessionRequest
    scene: Prepared
    """As for `complete`, with what the session chose in place of what was left to it."""
    start: SessionStart


def prepare_session(request: SessionRequest, console: Console) -> PreparedSession:
    """Open the scene as `complete` does."""
    results = request.completion.results
    check_output(results.out, results.overwrite)
    ready = prepare_completion(request.completion, console)
    print_lines(console, *describe_opening(ready.opened, ready.task))

    # What the session chose is recorded in summary.json as for `complete`: the context, and the
    # file into which the cameras of the session are saved.
    source = replace(ready.source, context=ready.task.context_frames)
    targets = TargetRequest((str(results.out / TARGETS_FILE),))
    scene = replace(ready, source=source, targets=targets)
    return PreparedSession(request, scene, describe_session_start(request, ready))


def begin_session(prepared: PreparedSession) -> Session:
    """Start the session."""
    ready = prepared.scene
    return Session(
        ready.completer,
        (ready.begin(),),
        ready.task.frame,
        ready.opened.photographs.origin,
        ready.opened.request.resolution,
        splat_origin=ready.task.splat_origin,
    )


def describe_session_start(request: SessionRequest, ready: Prepared) -> SessionStart:
    """Describe what a session began with, so that it can begin again; reads its splat."""
    splat = ready.work.splat
    known = None if splat is None or not splat.path.is_file() else hash_file(splat.path)
    reading = ready.source.scene
    config = ready.completer.config
    assert config is not None
    return SessionStart(
        {**request.record, "config": asdict(config)},
        request.resolution,
        reading.near,
        reading.far,
        # Cameras that were found are found again.
        ready.task.context_frames if ready.opened.has_numbered_frames else None,
        known,
    )


def save_session(prepared: PreparedSession, session: Session) -> str:
    """Write the results of `complete`, in place of those saved before, and return a sentence."""
    # The first completion of a session is the context alone.
    if len(session.completions) == 1:
        raise InputError("There is nothing to save; complete or repair something first.")
    out = prepared.request.out
    # Whether it may be replaced was decided when the session start.
    with open_output_folder(out, overwrite=True, command=COMPLETE_COMMAND) as folder:
        summary = write_session(folder, prepared, session)
    return f"Saved in {quote_value(out)}. {summary['outcome']['headline']}"


def write_session(folder: Path, prepared: PreparedSession, session: Session) -> dict[str, Any]:
    """Write the results of `complete` and the steps of a session, and return the summary."""
    ready = prepared.scene
    targets = [Target(result.target) for result in session.latest.targets]
    with_targets = replace(ready, task=replace(ready.task, targets=targets))
    summary = write_done(folder, with_targets, session.latest, "live")
    if session.cameras:
        write_cameras(folder / TARGETS_FILE, session.cameras)
    write_strokes(folder, session, prepared.start)
    return summary
