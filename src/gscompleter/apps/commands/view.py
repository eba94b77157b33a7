"""The command `view`: a scene before and after in the browser."""

from __future__ import annotations

import webbrowser
from contextlib import suppress
from pathlib import Path

from gscompleter.apps.commands.convert import check_free
from gscompleter.apps.commands.tool_options import ViewOptions
from gscompleter.apps.viewer import packages
from gscompleter.apps.viewer.exhibit import (
    ViewerContent,
    add_file_cameras,
    load_viewer_completion,
    load_viewer_files,
)
from gscompleter.apps.viewer.page import make_page
from gscompleter.apps.viewer.server import ADDRESS, make_page_server
from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import replace_file
from gscompleter.splats.sog import META


def run_view(options: ViewOptions) -> None:
    """Make the page, and write it or serve it until Ctrl-C."""
    if options.save is not None:
        check_page(options.save, options.overwrite)
    libraries = packages.load_libraries()
    page = make_page(load_content(options), libraries)
    for note in () if options.quiet else page.notes:
        print(note)
    if options.save is None:
        serve_page(options, page.html)
    else:
        with replace_file(options.save) as file:
            file.write(page.html)


def check_page(path: Path, overwrite: bool) -> None:
    """Refuse a file name without .html, and an existing file unless `overwrite` is set."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{quote_value(path)} is no .html file; name it *.html.", "save")
    check_free(path, overwrite)


def load_content(options: ViewOptions) -> ViewerContent:
    """Read the scenes and cameras of the options."""
    scene, other, drop_nonfinite = options.scene, options.other, options.drop_nonfinite
    if other is not None:
        content = load_viewer_files(other, scene, drop_nonfinite)
    elif scene.is_dir() and not (scene / META).is_file():
        content = load_viewer_completion(scene, drop_nonfinite)
    else:
        content = load_viewer_files(scene, None, drop_nonfinite)
    if options.cameras is None:
        return content
    return add_file_cameras(content, options.cameras, options.resolution)


def serve_page(options: ViewOptions, page: bytes) -> None:
    """Serve the page to this machine until Ctrl-C."""
    with make_page_server(page, options.port) as server, suppress(KeyboardInterrupt):
        address = f"http://{ADDRESS}:{server.server_address[1]}/"
        # Printed once the server listens.
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if not options.no_open:
            webbrowser.open(address)
        server.serve_forever()
