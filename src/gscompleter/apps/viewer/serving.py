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
from gscompleter.apps.report.schema import find_completed
from gscompleter.apps.requests.viewing import ViewRequest
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
from gscompleter.splats.alignment.trainer_frames import find_cameras_beside
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.sog import META
from gscompleter.splats.upward import Direction
from gscompleter.system.errors import InputError
from gscompleter.system.files.output_file import reserve_file
from gscompleter.system.files.result_names import SUMMARY_FILE
from gscompleter.system.files.writing import replace_file
from gscompleter.types import Camera
from gscompleter.virtual_capture.upward import find_upward, require_direction

LOCAL_ADDRESS = "127.0.0.1"
HOST_NAMES = (LOCAL_ADDRESS, "localhost")
"""Accepted host names; any other one may be a DNS rebinding attack by a website."""


def show_scenes(request: ViewRequest) -> None:
    """Make the page, and write it or serve it until Ctrl-C."""
    # What is wrong with the request is told before scenes are read.
    if request.up is not None:
        require_direction(request.up)
    if request.save is not None:
        # Reserved first, to refuse a file that may not be replaced.
        with reserve_file(request.save, request.overwrite):
            parts, notes = load_page(request)
            with replace_file(request.save) as file:
                file.writelines(parts)
        content = {"page": str(request.save), "notes": list(notes)}
        print_answer(request.answer, content, [*notes, request.save])
        return

    parts, notes = load_page(request)
    with make_page_server(b"".join(parts), request.port) as server, suppress(KeyboardInterrupt):
        address = f"http://{LOCAL_ADDRESS}:{server.server_address[1]}/"
        # Printed once the server listens.
        if request.answer.json:
            print_json({"url": address, "notes": list(notes)})
        else:
            # The address is needed even if nothing else is to be said.
            shown = [] if request.answer.quiet else notes
            print(*shown, f"{address} (Ctrl-C ends it)", sep="\n", flush=True)
        if request.opens_browser:
            webbrowser.open(address)
        server.serve_forever()


def load_page(request: ViewRequest) -> tuple[Iterator[bytes], Sequence[str]]:
    """Make the parts of the page of the scenes and cameras of a request, with notes on it."""
    # Libraries first: they may have to be downloaded, and a lack of network is said before large
    # scenes are read.
    libraries = packages.load_libraries()
    return make_page_parts(load_content(request), libraries)


def load_content(request: ViewRequest) -> ViewerContent:
    """Read the scenes and cameras of the request."""
    # A folder is that of a completion, of a trainer's model, or an unpacked .sog. That of a model
    # stands for its newest splat.
    scene = request.scene
    is_completion = (scene / SUMMARY_FILE).is_file()
    if not is_completion:
        scene = resolve_splat(scene)

    reading = request.drop_nonfinite, request.ignore_properties
    if request.other is not None:
        # B is the scene after, A the one before.
        content = load_viewer_files(request.other, scene, *reading)
    elif os.path.isdir(scene) and not os.path.isfile(scene / META):
        # A completion, or a folder of something else, which is refused for its missing summary.
        content = load_viewer_completion(scene, request.drop_nonfinite)
    else:
        content = load_viewer_files(scene, None, *reading)

    if request.cameras is not None:
        content = add_file_cameras(content, request.cameras, request.resolution)
    splat_file = find_completed(scene) if is_completion else scene
    return set_upward(content, request.up, splat_file)


def set_upward(content: ViewerContent, up: Direction | None, splat_file: Path) -> ViewerContent:
    """Set the upward direction of the page: `up`, or if there are no cameras, that of the splat.

    The page itself derives it from cameras that it shows. A note says how that of the splat was
    found. `splat_file` is the file of the splat, whose header and neighbours may tell it.
    """
    if up is not None:
        return replace(content, up=up)
    if content.cameras:
        return content
    cameras, notes = load_cameras_beside(splat_file)
    upward = find_upward(splat_file, content.after, load_renderer("cpu"), cameras=cameras)
    x, y, z = upward.direction.tolist()
    return replace(content, up=(x, y, z), notes=(*content.notes, *notes, *upward.describe()))


def load_cameras_beside(splat_file: Path) -> tuple[list[Camera], tuple[str, ...]]:
    """Load the cameras that lie beside a splat; none if they cannot be read, with a note on that.

    Nobody named that file, and it may be of another program, so it keeps no splat from being shown.
    """
    beside = find_cameras_beside(splat_file)
    if beside is None:
        return [], ()
    try:
        return load_cameras(beside), ()
    except InputError as error:
        return [], (f"The cameras beside the splat do not tell what is up. {error}",)


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
        return PageServer((LOCAL_ADDRESS, port), Handler)
    except OSError as error:
        raise InputError(
            f"Port {port} of {LOCAL_ADDRESS} is not available ({error.strerror}); "
            "name another one.",
            "port",
        ) from error
