"""The command `poses`: find the cameras of photographs."""

from __future__ import annotations

from rich.console import Console

from gscompleter.apps.commands.options import PosesOptions
from gscompleter.data.sfm.poses import find_poses
from gscompleter.system.progress import show_progress


def run_poses(options: PosesOptions) -> None:
    """Find and write the cameras, and print their number and error."""
    with show_progress(Console(stderr=True, quiet=options.quiet)):
        found = find_poses(options.photographs, options.out, options.overwrite, options.frames)
    if options.quiet:
        return
    for note in found.notes:
        print(note)
    print(
        f"{found.num_registered} of {found.photographs} cameras and {found.points:,} points, "
        f"mean error {found.error:.2f} px"
        f"{', found by an earlier run' if found.reused else ''}: {options.out}"
    )
