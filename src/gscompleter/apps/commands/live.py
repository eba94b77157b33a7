"""The command `live`: complete a scene in the browser."""

from __future__ import annotations

import webbrowser
from contextlib import suppress
from dataclasses import fields, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

from rich.console import Console

from gscompleter.apps.commands.complete import Prepared, prepare_completion, write_done
from gscompleter.apps.commands.options import (
    CompleteOptions,
    CompletingOptions,
    LiveOptions,
    parse_resolution,
)
from gscompleter.apps.commands.output import is_replaceable
from gscompleter.apps.inputs.opening import print_lines
from gscompleter.apps.inputs.plan import describe_opening
from gscompleter.apps.live.session import FrameConversion, Session
from gscompleter.apps.report.completion import Target
from gscompleter.data.scene import write_cameras
from gscompleter.errors import InputError, quote_value
from gscompleter.geometry import select_spread_cameras, shrink_camera
from gscompleter.io.files import TARGETS_FILE, open_output_folder
from gscompleter.progress import show_progress
from gscompleter.state import Completion
from gscompleter.types import Camera, View

if TYPE_CHECKING:
    from gscompleter.apps.live.page import Page

MAX_SHOWN = 40
"""Most photographs on the page, in addition to the context."""
THUMBNAIL_SIZE = 160
ANTIALIASED_NOTE = (
    "The page renders antialiased Gaussians as classic ones, small ones too opaque; saved files "
    "are correct, and so is `gscompleter view`."
)
"""Note on the page for antialiased scenes, which viser renders differently."""


def run_live(options: LiveOptions) -> None:
    """Serve the page until Ctrl-C."""
    if find_spec("viser") is None:
        raise InputError(
            "The live page needs viser, which is not installed; run "
            "pip install 'gscompleter[live]'."
        )
    # Imported here because viser may be missing.
    from gscompleter.apps.live.page import Page, PageServices

    console = Console(stderr=True, quiet=options.quiet)
    with show_progress(console):
        ready = prepare(options, console)
        services = PageServices(
            begin_session(ready),
            read_page_photographs(ready),
            lambda now: find_next_target(ready, now),
            Saver(ready).save,
        )
    page = Page(services, options.host, options.port)
    serve_session(page, options)


def prepare(options: LiveOptions, console: Console) -> Prepared:
    """Open the scene as `complete` does."""
    ready = prepare_completion(make_complete_options(options), console)
    print_lines(console, *describe_opening(ready.options, ready.opened, ready.task))
    if ready.task.scene is not None and ready.task.scene.is_antialiased:
        print_lines(console, ANTIALIASED_NOTE)
    target = (str(options.out / TARGETS_FILE),)
    named = replace(ready.options, context=ready.task.context_frames, target=target)
    return replace(ready, options=named)


def make_complete_options(options: LiveOptions) -> CompleteOptions:
    """Convert the options to those of `complete`."""
    shared = {field.name: getattr(options, field.name) for field in fields(CompletingOptions)}
    return CompleteOptions(**shared)


def begin_session(ready: Prepared) -> Session:
    """Start the session."""
    origin, resolution = ready.opened.photographs.origin, parse_resolution(ready.options.resolution)
    conversion = FrameConversion(ready.task.frame, origin, resolution)
    return Session(ready.completer, conversion, ready.begin())


def read_page_photographs(ready: Prepared) -> list[View]:
    """Read small photographs for the page: the context and others far apart."""
    context = [view.camera for view in ready.task.views]
    known = dict(zip(ready.task.context_frames, context, strict=True))
    others = [frame for frame in ready.cameras if frame not in known]
    chosen = select_spread_cameras([ready.cameras[f] for f in others], MAX_SHOWN) if others else []
    views = []
    for frame in (*known, *(others[index] for index in chosen)):
        camera = known[frame] if frame in known else ready.cameras[frame]
        small = shrink_camera(camera, THUMBNAIL_SIZE)
        with suppress(InputError):
            (view,) = ready.opened.photographs.views([frame], (small.height, small.width))
            views.append(View(view.image, camera.to("cpu"), frame))
    return views


def find_next_target(ready: Prepared, completion: Completion) -> Camera | None:
    """Find the next-best target camera."""
    choices = ready.explorer.plan(completion, list(ready.cameras.values()), 1)
    return choices[0].camera if choices else None


class Saver:
    """Saver of the session. It may replace its own results."""

    def __init__(self, ready: Prepared) -> None:
        self._ready, self._wrote = ready, False

    def save(self, session: Session) -> str:
        """Write the results of `complete`, and return a sentence."""
        options = self._ready.options
        if not session.steps:
            raise InputError("There is nothing to save; complete a hole first.")
        with open_output_folder(options.out, self._wrote or is_replaceable(options)) as folder:
            targets = [Target(result.target) for result in session.latest.targets]
            task = replace(self._ready.task, targets=targets)
            write_done(folder, replace(self._ready, task=task), session.latest)
            write_cameras(folder / TARGETS_FILE, [step.camera for step in session.steps])
        self._wrote = True
        return f"Saved in {quote_value(options.out)}."


def serve_session(page: Page, options: LiveOptions) -> None:
    """Print the address, open the page, and work until Ctrl-C."""
    address = f"http://{options.host}:{page.server.get_port()}/"
    # Printed once the server listens.
    print(f"{address} (Ctrl-C ends it)", flush=True)
    if not options.no_open:
        webbrowser.open(address)
    with suppress(KeyboardInterrupt):
        page.handle_requests()
    page.close()
