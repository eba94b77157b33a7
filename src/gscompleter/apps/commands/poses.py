"""The command `poses`: find the cameras of photographs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.options import ComputeOptions


@dataclass(frozen=True, kw_only=True)
class PosesOptions(ComputeOptions):
    """Find the cameras of photographs with COLMAP, and write a COLMAP folder.

    A second run with the same photographs keeps the result.
    """

    photographs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of overlapping photographs of one scene. They are not changed."""
    out: Path
    """Output folder: upright copies in images, cameras and points in sparse/0."""
    overwrite: bool = False
    """Replace the results of an earlier run in the output folder."""


def run_poses(options: PosesOptions) -> None:
    """Find and write the cameras, and print their number and error."""
    # Imported here so that `--help` does not wait for torch.
    from rich.console import Console

    from gscompleter.data.sfm.poses import find_poses
    from gscompleter.progress import show_progress

    with show_progress(None if options.quiet else Console(stderr=True)):
        found = find_poses(options.photographs, options.out, options.overwrite)
    if options.quiet:
        return
    for note in found.notes:
        print(note)
    print(
        f"{found.num_registered} of {found.photographs} cameras and {found.points:,} points, "
        f"mean error {found.error:.2f} px"
        f"{', found by an earlier run' if found.reused else ''}: {options.out}"
    )
