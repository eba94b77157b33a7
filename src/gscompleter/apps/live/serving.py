"""A session in the browser: the scene is opened, and its page served."""

from __future__ import annotations

import webbrowser
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from PIL import Image
from rich.console import Console

from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.live import LiveOptions
from gscompleter.apps.commands.shared_options import DEFAULT_NUM_TARGETS, CompletingOptions
from gscompleter.apps.completing.complete import write_done
from gscompleter.apps.completing.preparation import Prepared, prepare_completion
from gscompleter.apps.inputs.describing import describe_opening, print_lines
from gscompleter.apps.inputs.task import Target
from gscompleter.apps.live.addresses import check_bindable, resolve_host
from gscompleter.apps.live.difference import PageScene
from gscompleter.apps.live.page import LivePage
from gscompleter.apps.live.server import LiveServer
from gscompleter.apps.live.session import Session
from gscompleter.apps.live.strokes import STROKES, write_strokes
from gscompleter.apps.report.results import COMMAND, RESULTS
from gscompleter.apps.viewer import packages
from gscompleter.apps.viewer.exhibit import ViewerCamera, ViewerContent, shrink_image
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.apps.viewer.page import make_page
from gscompleter.data.photograph_names import name_photograph
from gscompleter.data.scene import write_cameras
from gscompleter.state import Completion
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.system.files.output_folder import check_output, open_output_folder, reserve_output
from gscompleter.system.files.writing import TARGETS_FILE
from gscompleter.system.progress import show_progress
from gscompleter.types import Camera

LIVE_RESULTS = (*RESULTS, *STROKES)
"""Globs of the files that a session may write."""


def serve_live(options: LiveOptions) -> None:
    """Serve the page until Ctrl-C."""
    # A port in use and a lack of the page's libraries are reported now, not after the scene is
    # reconstructed.
    check_bindable(resolve_host(options.host), options.host, options.port)
    libraries = packages.load_libraries()
    with reserve_output(options.out, options.overwrite, COMMAND, LIVE_RESULTS) as output:
        console = make_console(stderr=True, quiet=options.quiet)
        print_lines(console, *output.describe_others())
        with show_progress(console):
            ready = prepare(options, console)
            session = begin_session(ready)
            page = build_page(ready, session, libraries, console)
        serve(options, page)


def build_page(
    ready: Prepared, session: Session, libraries: Libraries, console: Console
) -> LivePage:
    """Build the page of a session."""
    scene = session.latest.context
    kind = "Photograph" if ready.opened.renders_from is None else "Render"
    shots = [
        ViewerCamera(
            f"photograph-{view.frame}",
            f"{kind} {name_photograph(view.frame, ready.opened.files.get(view.frame))}",
            view.camera.on_cpu,
            shrink_image(Image.fromarray(convert_to_pixels(view.image))),
        )
        for view in session.latest.views
    ]
    title = ready.options.scene or ready.options.folder
    assert title is not None
    content = ViewerContent(title.name, scene, scene, tuple(shots))
    page, notes = make_page(content, libraries, is_live=True)
    print_lines(console, *notes)
    return LivePage(
        session,
        page,
        PageScene(scene),
        lambda completion: find_next_target(ready, completion),
        lambda session: save_session(ready, session),
    )


def serve(options: LiveOptions, page: LivePage) -> None:
    """Serve a page until Ctrl-C."""
    server = LiveServer(resolve_host(options.host), options.host, options.port, page)
    # Printed once the server listens.
    if options.json:
        print_json({"url": server.url})
    else:
        print(f"{server.url} (Ctrl-C ends it)", flush=True)
    if not options.no_open:
        webbrowser.open(server.opening_url)
    with suppress(KeyboardInterrupt):
        page.handle_requests()
    server.close()


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


def find_next_target(ready: Prepared, completion: Completion) -> Camera | None:
    """Find the next-best target camera."""
    choices = ready.explorer.plan(completion, list(ready.cameras.values()), 1)
    return choices[0].camera if choices else None


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
    # Cameras that were found are found again.
    context = ready.task.context_frames if ready.opened.has_numbered_frames else None
    write_strokes(folder, session, ready.options, context)
    return summary
