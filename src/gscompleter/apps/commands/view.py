"""The command `view`: a scene before and after in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.shared_options import (
    Port,
    WritingOptions,
    list_inputs,
    refuse_size_alone,
)
from gscompleter.apps.requests.viewing import ViewRequest
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.overlap import refuse_input_file
from gscompleter.system.process import import_without_collection

SERVING_OPTIONS = ("port", "no_open")
"""Options of a page that is served, which one that is saved cannot follow."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions(WritingOptions):
    """Show a scene before and after its completion in the browser.

    Side by side, with a slider, or one at a time; generated Gaussians can be tinted or hidden.

    Example: gscompleter view result
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """Output folder of `complete`, or a file of Gaussians in any format that `convert` reads."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="B")] = None
    """The scene after, if A is the one before; by default A with its generated Gaussians."""
    cameras: Path | None = None
    """Cameras to look at the splat from: a file as in `complete --target`. Or a folder with a
    transforms.json or a COLMAP model. The page jumps to them. They are in the coordinates of the
    photographs if A is an output folder, else of A."""
    resolution: tuple[int, int] | None = None
    """Size of images in pixels. Height and width, at `--cameras`; those of its file if not
    given."""
    up: tuple[float, float, float] | None = None
    """Upward direction of the splat: x, y and z in its file (in the axes of a .ply). That of A;
    the page shows B in the same way. If not given, that of most cameras; without any, what the file
    says, else its floor, else -y."""
    save: Path | None = None
    """Write the page to this file instead of serving it."""
    port: Port = 0
    """Port of the page; a free one if not given. The page is on 127.0.0.1."""
    no_open: bool = False
    """Print the address without opening a browser."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    ignore_properties: bool = False
    """Go on with a splat whose further properties change what is seen, such as a moving one."""

    def check_overlap(self) -> None:
        """Refuse to write the page over an input."""
        if self.save is not None:
            refuse_input_file(self.save, list_inputs(self), "save")


def decide_view(options: ViewOptions) -> ViewRequest:
    """Decide what is shown, and where; raise InputError for options that nothing would follow."""
    if options.save is None and options.overwrite:
        raise InputError(
            "Nothing is written; name the file of the page with --save, or leave this out.",
            "overwrite",
        )
    for name in SERVING_OPTIONS:
        if options.save is not None and getattr(options, name) != getattr(ViewOptions, name):
            raise InputError("The page is saved and not served; leave this out, or --save.", name)
    if options.save is not None and options.save.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{quote_value(options.save)} is no .html file; name it *.html.", "save")
    refuse_size_alone(options.resolution, options.cameras)
    return ViewRequest(
        scene=options.scene,
        other=options.other,
        cameras=options.cameras,
        resolution=options.resolution,
        up=options.up,
        save=options.save,
        overwrite=options.overwrite,
        port=options.port,
        opens_browser=not options.no_open,
        drop_nonfinite=options.drop_nonfinite,
        ignore_properties=options.ignore_properties,
        answer=options.answer,
    )


def run_view(options: ViewOptions) -> None:
    """Make the page, and write it or serve it until Ctrl-C."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.viewer.serving import show_scenes
    show_scenes(decide_view(options))
