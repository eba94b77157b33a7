"""The command `strip`: the original scene of a completed one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.convert import check_free
from gscompleter.config.settings import Settings


@dataclass(frozen=True, kw_only=True)
class StripOptions(Settings):
    """Undo a completion: remove generated Gaussians and put pruned ones back."""

    completed: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="COMPLETED")]
    """Completed scene. Gaussians of a removed.ply beside it are put back."""
    out: Path
    """File for the original scene."""
    overwrite: bool = False
    """Replace an existing file."""
    quiet: bool = False
    """Print errors only."""


def run_strip(options: StripOptions) -> None:
    """Write the original scene and print the number of Gaussians."""
    # Imported here so that `--help` does not wait for torch.
    from rich.console import Console

    from gscompleter.progress import show_preparation, show_progress
    from gscompleter.splats.formats import get_writable_format
    from gscompleter.splats.strip import strip

    get_writable_format(options.out)
    check_free(options.out, options.overwrite)
    with (
        show_progress(None if options.quiet else Console(stderr=True)),
        show_preparation("stripping"),
    ):
        given, generated = strip(options.completed, options.out)
    if not options.quiet:
        print(f"{given:,} Gaussians, {generated:,} generated ones removed: {options.out}")
