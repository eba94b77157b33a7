"""The command `view`: a scene before and after in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gscompleter.commands.convert import check_free
from gscompleter.commands.options import Port
from gscompleter.config.settings import Settings
from gscompleter.errors import InputError, quoted

if TYPE_CHECKING:
    from gscompleter.viewer.exhibit import Exhibit
    from gscompleter.viewer.page import Page


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
    from gscompleter.viewer.packages import load_libraries
    from gscompleter.viewer.page import make_page

    if options.save is not None:
        check_page(options.save, options.overwrite)
    libraries = load_libraries()
    name = "page" if options.save is None else options.save.stem
    exhibit = exhibit_of(options)
    page = make_page(exhibit, libraries, name)
    if not options.quiet:
        tell(exhibit, page)
    if options.save is None:
        serve(options, page)
    else:
        write(page, options.save)


def check_page(path: Path, overwrite: bool) -> None:
    """Refuse a file name without .html, and an existing file unless `overwrite` is set."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{quoted(path)} is no .html file; name it *.html.", "save")
    check_free(path, overwrite)


def exhibit_of(options: ViewOptions) -> Exhibit:
    """Read the scenes and cameras of the options."""
    from dataclasses import replace

    from gscompleter.viewer.exhibit import (
        camera_shots,
        exhibit_of_completion,
        exhibit_of_files,
        is_completion,
    )

    if options.other is None and is_completion(options.scene):
        exhibit = exhibit_of_completion(options.scene, options.drop_nonfinite)
    elif options.other is None:
        exhibit = exhibit_of_files(options.scene, None, options.drop_nonfinite)
    else:
        exhibit = exhibit_of_files(options.other, options.scene, options.drop_nonfinite)
    if options.cameras is None:
        return exhibit
    shots = camera_shots(options.cameras, options.resolution, exhibit.place)
    return replace(exhibit, shots=(*exhibit.shots, *shots))


def tell(exhibit: Exhibit, page: Page) -> None:
    """Print remarks on the page."""
    for remark in exhibit.remarks:
        print(remark)
    if page.left_out:
        print(f"{page.left_out:,} Gaussians are too far away to be shown.")
    if page.parts:
        print(
            f"The Gaussians do not fit into one page; keep these {len(page.parts)} files beside "
            f"it: {', '.join(page.parts)}."
        )


def write(page: Page, path: Path) -> None:
    """Write the parts of the page, then the page."""
    from gscompleter.io.files import replacing

    for name, part in page.parts.items():
        with replacing(path.with_name(name)) as file:
            file.write(part)
    with replacing(path) as file:
        file.write(page.html)


def serve(options: ViewOptions, page: Page) -> None:
    """Serve the page to this machine until Ctrl-C."""
    import webbrowser
    from contextlib import suppress

    from gscompleter.viewer.server import ADDRESS, serving

    with serving(page, options.port) as server, suppress(KeyboardInterrupt):
        address = f"http://{ADDRESS}:{server.server_address[1]}/"
        # Printed once the server listens.
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if not options.no_open:
            webbrowser.open(address)
        server.serve_forever()
