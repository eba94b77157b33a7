"""The command `strip`: a completed scene as it was given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.commands.convert import check_free
from gscompleter.config.settings import Settings


@dataclass(frozen=True, kw_only=True)
class StripOptions(Settings):
    """Take everything that was generated out of a scene again, and put back what was set aside."""

    completed: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="COMPLETED")]
    """The completed scene. A removed.ply beside it is put back in its place."""
    out: Path
    """The file for the scene as it was given."""
    overwrite: bool = False
    """Replace the file where there is one."""
    quiet: bool = False
    """Say nothing but errors."""


def run_strip(options: StripOptions) -> None:
    """Write the scene as it was before its completion, and say how much that is.

    Raises:
        InputError: where nothing of it was given, or a file cannot be read or written.
    """
    # Here, so that `--help` does not wait for torch.
    from rich.console import Console

    from gscompleter.progress import preparing, shown_on
    from gscompleter.splats.formats import writable_format
    from gscompleter.splats.stripping import strip

    writable_format(options.out)
    check_free(options.out, options.overwrite)
    with shown_on(None if options.quiet else Console(stderr=True)), preparing("stripping"):
        given, generated = strip(options.completed, options.out)
    if not options.quiet:
        print(f"{given:,} Gaussians, {generated:,} generated ones taken out: {options.out}")
