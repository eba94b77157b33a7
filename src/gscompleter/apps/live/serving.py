"""A session in the browser: the scene is opened, and its page served."""

from __future__ import annotations

import os
import shlex
import webbrowser
from contextlib import closing, suppress
from pathlib import Path

from PIL import Image
from rich.console import Console

from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.live.addresses import check_bindable, resolve_host
from gscompleter.apps.live.difference import PageScene
from gscompleter.apps.live.journal import Journal
from gscompleter.apps.live.opening import LiveRequest
from gscompleter.apps.live.page import LivePage
from gscompleter.apps.live.replay import replay_steps
from gscompleter.apps.live.saving import (
    LIVE_RESULTS,
    PreparedSession,
    begin_session,
    prepare_session,
    save_session,
)
from gscompleter.apps.live.server import LiveServer
from gscompleter.apps.live.session import Session
from gscompleter.apps.live.steps import set_apart
from gscompleter.apps.live.strokes import list_steps
from gscompleter.apps.report.results import COMPLETE_COMMAND
from gscompleter.apps.viewer import packages
from gscompleter.apps.viewer.exhibit import ViewerCamera, ViewerContent, shrink_image
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.apps.viewer.page import make_page
from gscompleter.data.photograph_names import name_photograph
from gscompleter.system.console import make_console
from gscompleter.system.errors import quote_value
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.progress import show_progress
from gscompleter.types import Camera


def serve_live(request: LiveRequest) -> None:
    """Serve the page until Ctrl-C."""
    # A port in use and a lack of the page's libraries are reported now, not after the scene is
    # reconstructed.
    check_bindable(resolve_host(request.host), request.host, request.port)
    libraries = packages.load_libraries()
    asked = request.session
    results = asked.completion.results
    with reserve_output(results.out, results.overwrite, COMPLETE_COMMAND, LIVE_RESULTS) as output:
        console = make_console(stderr=True, quiet=results.answer.quiet)
        print_lines(console, *asked.notes, *output.describe_others())
        with show_progress(console):
            prepared = prepare_session(asked, console)
            session = open_session(prepared, console)
            journal = open_journal(prepared, session)
            page = build_page(prepared, session, libraries, console, journal)
        serve(request, page)
        print_lines(console, *describe_end(page.session, journal))


def open_session(prepared: PreparedSession, console: Console) -> Session:
    """Begin a session, and do the steps again that it goes on from."""
    asked = prepared.request
    return replay_steps(begin_session(prepared), asked.steps, asked.undone, console)


def open_journal(prepared: PreparedSession, session: Session) -> Journal:
    """Open the journal of a session, which has what was done again."""
    journal = Journal(prepared.request.out, prepared.start, prepared.request.saved)
    if list_steps(session):
        journal.write(session)
    return journal


def describe_end(session: Session, journal: Journal) -> list[str]:
    """Write the lines that a session ends with; none if nothing was done."""
    if not list_steps(session) and not journal.has_saved:
        return []
    out = quote_value(journal.folder)
    if not journal.has_begun:
        return [f"Not saved: {out} has neither the steps nor a result."]
    has_steps = journal.has_steps(session)
    steps = "has the steps, and" if has_steps else "lacks what was done last, and has"
    state = f"Not saved: {out} {steps} no result."
    # Where all steps are undone, nothing is left to be saved: this alone is no result.
    if journal.has_saved:
        state = f"Not saved: {out} {steps} the result of an earlier Save."
        if journal.is_saved(session):
            state = f"Saved in {out}."
    command = shlex.join(["gscompleter", "live", str(journal.folder)])
    return [state, f"To go on: {command}"]


def build_page(
    prepared: PreparedSession,
    session: Session,
    libraries: Libraries,
    console: Console,
    journal: Journal,
) -> LivePage:
    """Build the page of a session, and print notes on what it cannot show."""
    ready = prepared.scene
    # The page holds the scene as it was given. What was added or changed since, by steps or as the
    # session began, is a difference to it.
    first = session.completions[0]
    scene = first.context
    kind = "Photograph" if ready.opened.renders_from is None else "View"
    shots = [
        ViewerCamera(
            f"photograph-{view.frame}",
            f"{kind} {name_photograph(view.frame, ready.opened.files.get(view.frame))}",
            view.camera.on_cpu,
            shrink_image(Image.fromarray(convert_to_pixels(view.image))),
        )
        # A removal paints over its place in photographs; they are shown without that.
        for view in first.views
    ]
    # The page itself has the same states before and after; the difference changes the latter.
    content = ViewerContent(name_session(ready), scene, scene, tuple(shots))
    page, notes = make_page(content, libraries, is_live=True)
    print_lines(console, *notes)
    return LivePage(
        session,
        page,
        PageScene(scene),
        lambda session: find_next_target(ready, session),
        lambda session: save_session(prepared, session),
        journal,
    )


def name_session(ready: Prepared) -> str:
    """Name a session by its splat, or by the folder of its photographs."""
    splat = ready.work.splat
    path = ready.source.scene.folder if splat is None else splat.path
    # "." has no name of its own. A link keeps its name.
    return Path(os.path.abspath(path)).name


def serve(request: LiveRequest, page: LivePage) -> None:
    """Serve a page until Ctrl-C."""
    server = LiveServer(resolve_host(request.host), request.host, request.port, page)
    with closing(server), suppress(KeyboardInterrupt):
        # Printed once the server listens.
        if request.session.completion.results.answer.json:
            print_json({"url": server.url})
        else:
            print(f"{server.url} (Ctrl-C ends it)", flush=True)
        if request.opens_browser:
            webbrowser.open(server.opening_url)
        page.handle_requests()


def find_next_target(ready: Prepared, session: Session) -> Camera | None:
    """Find the next-best target camera: first for what was removed, then for other holes.

    None if no hole is worth a target.
    """
    # The settings of a removal know no other holes; where nothing was removed both are the same.
    latest = session.latest
    elsewhere = set_apart(session.first_config, latest)
    for state in (latest,) if elsewhere is latest else (latest, elsewhere):
        choices = ready.explorer.plan(state, list(ready.cameras.values()), 1)
        if choices:
            return choices[0].camera
    return None
