"""The command `poses`: photographs in, their cameras out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.commands.options import ComputeOptions


@dataclass(frozen=True, kw_only=True)
class PosesOptions(ComputeOptions):
    """Find the cameras of photographs, and write them as a COLMAP folder (images and sparse/0).

    Run again with the same photographs, it keeps what it found.
    """

    photographs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photographs of one scene that overlap. They are read, and stay as they are."""
    out: Path
    """The folder to write: upright copies in images, cameras and points in sparse/0."""
    overwrite: bool = False
    """Replace what an earlier run left in the output folder."""


def run_poses(options: PosesOptions) -> None:
    """Find the cameras, write them, and say how many there are and how well they fit.

    Raises:
        InputError: where there are too few photographs, none can be placed, or the folder cannot
            be written.
    """
    # Here, so that `--help` waits for nothing.
    from rich.console import Console

    from gscompleter.data.structure_from_motion import find_poses
    from gscompleter.progress import shown_on

    with shown_on(None if options.quiet else Console(stderr=True)):
        found = find_poses(options.photographs, options.out, options.overwrite)
    if options.quiet:
        return
    for note in found.notes:
        print(note)
    print(
        f"{found.registered} of {found.photographs} cameras and {found.points:,} points, "
        f"{found.error:.2f} px off on average"
        f"{', found by an earlier run' if found.reused else ''}: {options.out}"
    )
