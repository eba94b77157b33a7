"""The command `live`: complete a scene in the browser."""

from __future__ import annotations

import webbrowser
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

from rich.console import Console

from gscompleter.commands.complete import Done, prepared, write_done
from gscompleter.commands.exploring import cameras_of
from gscompleter.commands.opening import Opened, Task, say
from gscompleter.commands.options import (
    CompleteOptions,
    CompletingOptions,
    LiveOptions,
    working_size,
)
from gscompleter.commands.output import replaceable, saying_what_stays
from gscompleter.commands.understood import found_out
from gscompleter.completer import total
from gscompleter.data.scene import write_cameras
from gscompleter.errors import InputError, quoted
from gscompleter.explorer import Explorer
from gscompleter.io.files import TARGETS, output_folder
from gscompleter.live.session import Place, Session
from gscompleter.progress import shown_on
from gscompleter.reports.completion import Target
from gscompleter.stages.candidates import shrunk, spread_cameras
from gscompleter.types import Camera, Completion, View

if TYPE_CHECKING:
    from gscompleter.live.page import Page

SHOWN = 40
"""Most photographs on the page, in addition to the context."""
THUMBNAIL = 160
CLASSIC = (
    "The page renders antialiased Gaussians as classic ones, small ones too opaque; saved files "
    "are correct, and so is `gscompleter view`."
)
"""Note on the page for antialiased scenes, which viser renders differently."""


@dataclass(frozen=True)
class Prepared:
    """Everything that is loaded before the first completion."""

    options: CompleteOptions
    opened: Opened
    task: Task
    explorer: Explorer
    cameras: Mapping[int, Camera]
    """Cameras of all usable photographs by frame, in the frame of the result."""
    seconds: Mapping[str, float]


def run_live(options: LiveOptions) -> None:
    """Serve the page until Ctrl-C."""
    check_viser()
    # Imported here because viser may be missing.
    from gscompleter.live.page import Page, Subject

    console = Console(stderr=True, quiet=options.quiet)
    with saying_what_stays(options.out):
        with shown_on(None if options.quiet else console):
            ready = prepare(options, console)
            session = begin(ready)
            photographs = photographs_of(ready)
        saver = Saver(ready)
        subject = Subject(session, photographs, lambda now: hole_of(ready, now), saver.save)
        page = Page(subject, options.host, options.port)
    serve(page, options)


def check_viser() -> None:
    """Refuse to continue without viser."""
    if find_spec("viser") is None:
        raise InputError(
            "The live page needs viser, which is not installed; run "
            "pip install 'gscompleter[live]'."
        )


def prepare(options: LiveOptions, console: Console) -> Prepared:
    """Open the scene as `complete` does."""
    as_complete_options = as_complete(options)
    opened, task, explorer, seconds = prepared(as_complete_options, console)
    say(console, *found_out(as_complete_options, opened, task))
    if task.scene is not None and task.scene.is_antialiased:
        say(console, CLASSIC)
    frames = frames_of(task)
    as_complete_options = replace(
        as_complete_options, context=frames, target=(str(options.out / TARGETS),)
    )
    return Prepared(
        as_complete_options,
        opened,
        task,
        explorer,
        cameras_of(as_complete_options, opened, task),
        seconds,
    )


def as_complete(options: LiveOptions) -> CompleteOptions:
    """Convert the options to those of `complete`."""
    shared = {field.name: getattr(options, field.name) for field in fields(CompletingOptions)}
    return CompleteOptions(**shared)


def frames_of(task: Task) -> tuple[int, ...]:
    """Return the frame numbers of the context."""
    return tuple(view.frame for view in task.views if view.frame is not None)


def begin(ready: Prepared) -> Session:
    """Start the session."""
    task, completer = ready.task, ready.explorer.completer
    origin, resolution = ready.opened.photographs.origin, working_size(ready.options.resolution)
    begun = completer.begin(task.views, task.scene, task.witnesses)
    return Session(completer, Place(task.frame, origin, resolution), begun)


def photographs_of(ready: Prepared) -> list[View]:
    """Read small photographs for the page: the context and others far apart."""
    cameras = [view.camera for view in ready.task.views]
    known = dict(zip(frames_of(ready.task), cameras, strict=True))
    others = [frame for frame in ready.cameras if frame not in known]
    chosen = spread_cameras([ready.cameras[f] for f in others], SHOWN) if others else []
    views = []
    for frame in (*known, *(others[index] for index in chosen)):
        camera = known[frame] if frame in known else ready.cameras[frame]
        small = shrunk(camera, THUMBNAIL)
        with suppress(InputError):
            (view,) = ready.opened.photographs.views([frame], (small.height, small.width))
            views.append(View(view.image, camera.to("cpu"), frame))
    return views


def hole_of(ready: Prepared, completion: Completion) -> Camera | None:
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
        with output_folder(options.out, self._wrote or replaceable(options)) as folder:
            write_done(folder, options, done(self._ready, session), self._ready.explorer)
            write_cameras(folder / TARGETS, [step.told for step in session.steps])
        self._wrote = True
        return f"Saved in {quoted(options.out)}."


def done(ready: Prepared, session: Session) -> Done:
    """Describe the session as a finished completion."""
    now = session.now
    completion = replace(now, seconds=total(now.seconds, ready.seconds))
    targets = [Target(result.target) for result in now.targets]
    return Done(ready.opened, replace(ready.task, targets=targets), ready.cameras, completion)


def serve(page: Page, options: LiveOptions) -> None:
    """Print the address, open the page, and work until Ctrl-C."""
    address = f"http://{options.host}:{page.server.get_port()}/"
    # Printed once the server listens.
    print(f"{address} (Ctrl-C ends it)", flush=True)
    if not options.no_open:
        webbrowser.open(address)
    with suppress(KeyboardInterrupt):
        page.work()
    page.close()
