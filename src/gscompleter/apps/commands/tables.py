"""The command `tables`: print and write the tables of an evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.shared_options import Options
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class TablesOptions(Options):
    """Print and write the tables of an evaluation, finished or not.

    Example: gscompleter tables scores
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output folder of `evaluate`; the tables are written there."""
    fid: bool = False
    """Also compute the FID of each method."""


def run_tables(options: TablesOptions) -> None:
    """Write the tables of an evaluation, and print them."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.evaluating.tables import write_and_print_tables
        from gscompleter.system.console import make_console
        from gscompleter.system.progress import show_progress
    with show_progress(make_console(stderr=True, quiet=options.quiet)):
        write_and_print_tables(options.out, options.quiet, options.fid, as_json=options.json)
