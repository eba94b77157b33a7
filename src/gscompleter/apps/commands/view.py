"""The command `view`: a scene before and after in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gscompleter.apps.commands.convert import check_free
from gscompleter.apps.commands.options import Port
from gscompleter.config.settings import Settings
from gscompleter.errors import InputError, quote_value

if TYPE_CHECKING:
    from gscompleter.apps.viewer.exhibit import ViewerContent
    from gscompleter.apps.viewer.page import Page


@dataclass(frozen=True, kw_only=True)
class ViewOptions(Settings):
    """Show a scene before and after its completion in the browser.

    Side by side, with a slider, or one at a time; generated Gaussians can be tinted or hidden.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """Output folder of `complete`, or a file of Gaussians in any format that `convert` reads."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="B")] = None
    """Scene after completion if A is the scene before. If not given, A is shown with and without
    its generated Gaussians."""
    cameras: Path | None = None
    """Cameras to jump to: a file of cameras as in `complete --target`, or a folder with a
    transforms.json or a COLMAP model. They are in the coordinates of the photographs if A is an
    output folder, otherwise in those of A."""
    resolution: tuple[int, int] | None = None
    """Image size (height and width) of cameras whose file has none."""
    save: Path | None = None
    """Write the page to this file instead of serving it."""
    overwrite: bool = False
    """Replace an existing file."""
    port: Port = 0
    """Port of the page on 127.0.0.1; a free one if not given."""
    no_open: bool = False
    """Print the address without opening a browser."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    quiet: bool = False
    """Print errors only."""


def run_view(options: ViewOptions) -> None:
    """Make the page, and write it or serve it until Ctrl-C."""
    # Imported here so that `--help` does not wait for torch.
    from gscompleter.apps.viewer.packages import load_libraries
    from gscompleter.apps.viewer.page import make_page

    if options.save is not None:
        check_page(options.save, options.overwrite)
    libraries = load_libraries()
    name = "page" if options.save is None else options.save.stem
    exhibit = load_exhibit(options)
    page = make_page(exhibit, libraries, name)
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
    from dataclasses import replace

    from gscompleter.apps.viewer.exhibit import (
        is_completion,
        load_file_cameras,
        load_viewer_completion,
        load_viewer_files,
    )

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
    from gscompleter.io.files import replace_file

    for name, part in page.parts.items():
        with replace_file(path.with_name(name)) as file:
            file.write(part)
    with replace_file(path) as file:
        file.write(page.html)


def serve_page(options: ViewOptions, page: Page) -> None:
    """Serve the page to this machine until Ctrl-C."""
    import webbrowser
    from contextlib import suppress

    from gscompleter.apps.viewer.server import ADDRESS, make_page_server

    with make_page_server(page, options.port) as server, suppress(KeyboardInterrupt):
        address = f"http://{ADDRESS}:{server.server_address[1]}/"
        # Printed once the server listens.
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if not options.no_open:
            webbrowser.open(address)
        server.serve_forever()
