"""The command `view`: a scene before and after in the browser."""

from __future__ import annotations

import webbrowser
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from gscompleter.apps.commands.convert import check_free
from gscompleter.apps.commands.options import ViewOptions
from gscompleter.apps.viewer import packages
from gscompleter.apps.viewer.exhibit import (
    ViewerContent,
    is_completion,
    load_file_cameras,
    load_viewer_completion,
    load_viewer_files,
)
from gscompleter.apps.viewer.page import Page, make_page
from gscompleter.apps.viewer.server import ADDRESS, make_page_server
from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import replace_file


def run_view(options: ViewOptions) -> None:
    """Make the page, and write it or serve it until Ctrl-C."""
    if options.save is not None:
        check_page(options.save, options.overwrite)
    libraries = packages.load_libraries()
    exhibit = load_exhibit(options)
    page = make_page(exhibit, libraries, "page" if options.save is None else options.save.stem)
    if not options.quiet:
        print_remarks(exhibit, page)
    if options.save is None:
        serve_page(options, page)
    else:
        write_parts(page, options.save)


def check_page(path: Path, overwrite: bool) -> None:
    """Refuse a file name without .html, and an existing file unless `overwrite` is set."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{quote_value(path)} is no .html file; name it *.html.", "save")
    check_free(path, overwrite)


def load_exhibit(options: ViewOptions) -> ViewerContent:
    """Read the scenes and cameras of the options."""
    if options.other is None and is_completion(options.scene):
        exhibit = load_viewer_completion(options.scene, options.drop_nonfinite)
    elif options.other is None:
        exhibit = load_viewer_files(options.scene, None, options.drop_nonfinite)
    else:
        exhibit = load_viewer_files(options.other, options.scene, options.drop_nonfinite)
    if options.cameras is None:
        return exhibit
    shots = load_file_cameras(options.cameras, options.resolution, exhibit.scene_transform)
    return replace(exhibit, cameras=(*exhibit.cameras, *shots))


def print_remarks(exhibit: ViewerContent, page: Page) -> None:
    """Print remarks on the page."""
    for remark in exhibit.notes:
        print(remark)
    if page.num_omitted:
        print(f"{page.num_omitted:,} Gaussians are too far away to be shown.")
    if page.parts:
        print(
            f"The Gaussians do not fit into one page; keep these {len(page.parts)} files beside "
            f"it: {', '.join(page.parts)}."
        )


def write_parts(page: Page, path: Path) -> None:
    """Write the parts of the page, then the page."""
    for name, part in page.parts.items():
        with replace_file(path.with_name(name)) as file:
            file.write(part)
    with replace_file(path) as file:
        file.write(page.html)


def serve_page(options: ViewOptions, page: Page) -> None:
    """Serve the page to this machine until Ctrl-C."""
    with make_page_server(page, options.port) as server, suppress(KeyboardInterrupt):
        address = f"http://{ADDRESS}:{server.server_address[1]}/"
        # Printed once the server listens.
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if not options.no_open:
            webbrowser.open(address)
        server.serve_forever()
