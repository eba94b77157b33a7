"""The command `inspect`: what is in a splat, and what of it is invented."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.shared_options import DeviceOptions, refuse_size_alone
from gscompleter.apps.requests.viewing import InspectionRequest
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class InspectOptions(DeviceOptions):
    """Print what is in a splat, what of it is invented, by whom, and its share of pictures.

    Pictures are at `--cameras`, or at the cameras of the completion in whose folder FILE lies.

    Example: gscompleter inspect result/completed.ply
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File of Gaussians in any format that `convert` reads, or output folder of `complete` or
    `clean`."""
    cameras: Path | None = None
    """Cameras to look at the splat from: a file as in `complete --target`. Or a folder with a
    transforms.json or a COLMAP model. Their pictures are measured. They are in the coordinates of
    the photographs if FILE lies in an output folder of `complete`, else of FILE."""
    resolution: tuple[int, int] | None = None
    """Size of images in pixels. Height and width, at `--cameras`; those of its file if not
    given."""
    json: bool = False
    """Print the result as JSON."""


def run_inspect(options: InspectOptions) -> None:
    """Inspect the splat and print the result; raise InputError for options that do not fit."""
    refuse_size_alone(options.resolution, options.cameras)
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.inspection import inspect_splat, print_inspection
        from gscompleter.render.device import choose_device

    request = InspectionRequest(
        file=options.file,
        cameras=options.cameras,
        resolution=options.resolution,
        device=choose_device(options.device),
    )
    print_inspection(inspect_splat(request), options.json)
