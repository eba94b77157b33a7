"""A session in the browser: the scene is opened, and its page served."""

from __future__ import annotations

import webbrowser
from contextlib import suppress
from dataclasses import fields, replace
from importlib.util import find_spec

from rich.console import Console

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.live import LiveOptions
from gscompleter.apps.commands.shared_options import DEFAULT_NUM_TARGETS, CompletingOptions
from gscompleter.apps.completing.complete import COMMAND, RESULTS, write_done
from gscompleter.apps.completing.preparation import Prepared, prepare_completion
from gscompleter.apps.inputs.describing import describe_opening, print_lines
from gscompleter.apps.inputs.task import Target
from gscompleter.apps.live.session import Session
from gscompleter.data.scene import write_cameras
from gscompleter.state import Completion
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import check_output, open_output_folder, reserve_output
from gscompleter.system.files.writing import TARGETS_FILE
from gscompleter.system.progress import show_progress
from gscompleter.types import Camera

# viser renders antialiased scenes differently.
ANTIALIASED_NOTE = (
    "The page renders antialiased Gaussians as classic ones, small ones too opaque; saved files "
    "are correct, and so is `gscompleter view`."
)


def serve_live(options: LiveOptions) -> None:
    """Serve the page until Ctrl-C."""
    if find_spec("viser") is None:
        raise InputError(
            "The live page needs viser, which is not installed; run "
            "pip install 'gscompleter[live]'."
        )
    from gscompleter.apps.live.page import check_bindable, resolve_host

    # A port in use is reported now, not after the scene is reconstructed.
    check_bindable(resolve_host(options.host), options.host, options.port)
    with reserve_output(options.out, options.overwrite, COMMAND, RESULTS) as output:
        console = Console(stderr=True, quiet=options.quiet)
        print_lines(console, *output.describe_others())
        with show_progress(console):
            ready = prepare(options, console)
            session = begin_session(ready)
        serve(options, ready, session)


def serve(options: LiveOptions, ready: Prepared, session: Session) -> None:
    """Serve the page of a session until Ctrl-C."""
    # Imported here because viser may be missing.
    from gscompleter.apps.live.page import Page, resolve_host, start_server

    server = start_server(options.host, options.port)
    page = Page(
        session,
        lambda now: find_next_target(ready, now),
        lambda session: save_session(ready, session),
        server,
        ready.opened.files,
    )
    address = resolve_host(options.host).make_url(server.get_port())
    # Printed once the server listens.
    print(f"{address} (Ctrl-C ends it)", flush=True)
    if not options.no_open:
        webbrowser.open(address)
    with suppress(KeyboardInterrupt):
        page.handle_requests()
    page.close()


def prepare(options: LiveOptions, console: Console) -> Prepared:
    """Open the scene as `complete` does."""
    check_output(options.out, options.overwrite)
    ready = prepare_completion(make_complete_options(options), console)
    print_lines(console, *describe_opening(ready.opened, ready.task))
    if ready.task.scene is not None and ready.task.scene.is_antialiased:
        print_lines(console, ANTIALIASED_NOTE)

    # What the session chose is recorded in summary.json as options of `complete`: the context, and
    # the file into which the cameras of the session are saved.
    target = (str(options.out / TARGETS_FILE),)
    complete_options = replace(ready.options, context=ready.task.context_frames, target=target)
    return replace(ready, options=complete_options)


def make_complete_options(options: LiveOptions) -> CompleteOptions:
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
    )


def find_next_target(ready: Prepared, completion: Completion) -> Camera | None:
    """Find the next-best target camera."""
    choices = ready.explorer.plan(completion, list(ready.cameras.values()), 1)
    return choices[0].camera if choices else None


def save_session(ready: Prepared, session: Session) -> str:
    """Write the results of `complete`, in place of those saved before, and return a sentence."""
    # The first completion of a session is the context alone.
    if len(session.completions) == 1:
        raise InputError("There is nothing to save; complete a hole first.")
    out = ready.options.out
    targets = [Target(result.target) for result in session.latest.targets]
    with_targets = replace(ready, task=replace(ready.task, targets=targets))
    # Whether it may be replaced was decided when the session began.
    with open_output_folder(out, overwrite=True, command=COMMAND) as folder:
        summary = write_done(folder, with_targets, session.latest)
        if session.cameras:
            write_cameras(folder / TARGETS_FILE, session.cameras)
    return f"Saved in {quote_value(out)}. {summary['outcome']['headline']}"
