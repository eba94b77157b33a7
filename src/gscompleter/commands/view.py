"""The command `view`: a scene before and after, in the browser."""

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
    """Look at a scene before and after its completion in the browser: side by side, under a
    slider, or one in place of the other, with what was generated tinted or hidden."""

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """What `complete` wrote (OUT), or a file of Gaussians in any format that `convert` reads."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="B")] = None
    """The scene after, where A is the one before. Without it A is shown with and without what was
    generated."""
    cameras: Path | None = None
    """Cameras to jump to: a file of cameras, as `complete --target` takes it, or a folder with a
    transforms.json or a COLMAP model. They are in the frame of the photographs where A is an OUT,
    and else in that of A."""
    resolution: tuple[int, int] | None = None
    """Height and width of the images of cameras whose file does not tell them."""
    save: Path | None = None
    """Write the page to this file instead of serving it."""
    overwrite: bool = False
    """Replace the file where there is one."""
    port: Port = 0
    """Port of 127.0.0.1 to serve at; any that is free if not given."""
    no_open: bool = False
    """Only say where the page is, and open no browser."""
    drop_nonfinite: bool = False
    """Leave out Gaussians that hold NaN or infinity."""
    quiet: bool = False
    """Say nothing but errors."""


def run_view(options: ViewOptions) -> None:
    """Make the page, and write it or serve it until Ctrl-C.

    Raises:
        InputError: where something cannot be read, fetched or written.
    """
    # Here, so that `--help` does not wait for torch.
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
    """Refuse a name that no browser takes for a page, and to replace a file unasked.

    Raises:
        InputError: where `path` is such a name, or is there and `overwrite` is off.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{quoted(path)} is not named as a page; name it *.html.", "save")
    check_free(path, overwrite)


def exhibit_of(options: ViewOptions) -> Exhibit:
    """What the options name.

    Raises:
        InputError: where it cannot be read.
    """
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
    """Say what one would otherwise wonder about."""
    for remark in exhibit.remarks:
        print(remark)
    if page.left_out:
        print(f"{page.left_out:,} Gaussians lie too far out to be shown.")
    if page.parts:
        print(
            f"The Gaussians are too large for one page: they lie beside it in {len(page.parts)} "
            f"files, {', '.join(page.parts)}, which have to stay with it."
        )


def write(page: Page, path: Path) -> None:
    """Write the page last, so that it never lacks its parts.

    Raises:
        InputError: where a file cannot be written.
    """
    from gscompleter.io.files import replacing

    for name, part in page.parts.items():
        with replacing(path.with_name(name)) as file:
            file.write(part)
    with replacing(path) as file:
        file.write(page.html)


def serve(options: ViewOptions, page: Page) -> None:
    """Serve the page to this machine until Ctrl-C.

    Raises:
        InputError: where the port is taken.
    """
    import webbrowser
    from contextlib import suppress

    from gscompleter.viewer.server import ADDRESS, serving

    with serving(page, options.port) as server, suppress(KeyboardInterrupt):
        address = f"http://{ADDRESS}:{server.server_address[1]}/"
        # Whoever waits for this line finds the server listening.
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if not options.no_open:
            webbrowser.open(address)
        server.serve_forever()
