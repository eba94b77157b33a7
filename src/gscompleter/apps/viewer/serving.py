"""The page of a scene before and after, written or served."""

from __future__ import annotations

import os
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from http.server import ThreadingHTTPServer
from pathlib import Path

from gscompleter.apps.command_line.answers import print_answer, print_json
from gscompleter.apps.commands.view import ViewOptions
from gscompleter.apps.inputs.captures import find_cameras_beside
from gscompleter.apps.report.schema import find_completed
from gscompleter.apps.viewer import packages
from gscompleter.apps.viewer.exhibit import (
    ViewerContent,
    add_file_cameras,
    load_viewer_completion,
    load_viewer_files,
)
from gscompleter.apps.viewer.http import HTML, PageHandler, PageServer
from gscompleter.apps.viewer.page import make_page_parts
from gscompleter.data.scene import load_cameras
from gscompleter.render.loading import load_renderer
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.sog import META
from gscompleter.splats.upward import Direction
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_file import reserve_file
from gscompleter.system.files.writing import SUMMARY_FILE, replace_file
from gscompleter.virtual_capture.upward import find_upward, require_direction

ADDRESS = "127.0.0.1"
HOST_NAMES = (ADDRESS, "localhost")
"""Accepted host names; any other one may be a DNS rebinding attack by a website."""


def show_scenes(options: ViewOptions) -> None:
    """Make the page, and write it or serve it until Ctrl-C."""
    if options.save is not None:
        if options.save.suffix.lower() not in (".html", ".htm"):
            name = quote_value(options.save)
            raise InputError(f"{name} is no .html file; name it *.html.", "save")
        # Reserved first: a file that may not be replaced ends the command before scenes are read.
        with reserve_file(options.save, options.overwrite):
            parts, notes = load_page(options)
            with replace_file(options.save) as file:
                file.writelines(parts)
        content = {"page": str(options.save), "notes": list(notes)}
        print_answer(options, content, [*notes, options.save])
        return

    parts, notes = load_page(options)
    with make_page_server(b"".join(parts), options.port) as server, suppress(KeyboardInterrupt):
        address = f"http://{ADDRESS}:{server.server_address[1]}/"
        # Printed once the server listens.
        if options.json:
            print_json({"url": address, "notes": list(notes)})
        else:
            print(
                *(() if options.quiet else notes),
                f"{address} (Ctrl-C ends it)",
                sep="\n",
                flush=True,
            )
        if not options.no_open:
            webbrowser.open(address)
        server.serve_forever()


def load_page(options: ViewOptions) -> tuple[Iterator[bytes], Sequence[str]]:
    """Make the parts of the page of the scenes and cameras of the options, with notes on it."""
    # Libraries first: they may have to be downloaded, and a lack of network is said before large
    # scenes are read.
    libraries = packages.load_libraries()
    return make_page_parts(load_content(options), libraries)


def load_content(options: ViewOptions) -> ViewerContent:
    """Read the scenes and cameras of the options."""
    # A folder is that of a completion, of a trainer's model, or an unpacked .sog.
    scene = options.scene
    if not (scene / SUMMARY_FILE).is_file():
        scene = resolve_splat(scene)

    reading = options.drop_nonfinite, options.ignore_properties
    if options.other is not None:
        # B is the scene after, A the one before.
        content = load_viewer_files(options.other, scene, *reading)
    elif os.path.isdir(scene) and not os.path.isfile(scene / META):
        content = load_viewer_completion(scene, options.drop_nonfinite)
    else:
        content = load_viewer_files(scene, None, *reading)

    if options.cameras is not None:
        content = add_file_cameras(content, options.cameras, options.resolution)
    is_completion = (scene / SUMMARY_FILE).is_file()
    return set_upward(content, options.up, find_completed(scene) if is_completion else scene)


def set_upward(content: ViewerContent, up: Direction | None, path: Path) -> ViewerContent:
    """Set what is up on the page, which the cameras show otherwise; a note says what was found."""
    if up is not None:
        require_direction(up)
        return replace(content, up=up)
    if content.cameras:
        return content
    beside = find_cameras_beside(path)
    cameras = [] if beside is None else load_cameras(beside)
    upward = find_upward(path, content.after, load_renderer("cpu"), cameras=cameras)
    x, y, z = upward.direction.tolist()
    return replace(content, up=(x, y, z), notes=(*content.notes, *upward.describe()))


def make_page_server(page: bytes, port: int = 0) -> ThreadingHTTPServer:
    """Make a server on `port` (0 for any) that shows the page to browsers of this machine."""

    class Handler(PageHandler):
        def do_GET(self) -> None:
            if self.headers.get("Host", "").rsplit(":", 1)[0].lower() not in HOST_NAMES:
                self.send_error(421, "This server answers to 127.0.0.1 and localhost only")
            elif self.path != "/":
                self.send_error(404)
            else:
                self.send_content(page, HTML)

    try:
        return PageServer((ADDRESS, port), Handler)
    except OSError as error:
        raise InputError(
            f"Port {port} of {ADDRESS} is not available ({error.strerror}); name another one.",
            "port",
        ) from error
