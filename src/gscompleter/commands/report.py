"""The command `report`: the page on a completion or an evaluation, made again."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.config.settings import Settings


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Settings):
    """Make report.html of a completion or an evaluation again, from what lies in its folder."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The folder that `complete`, `demo` or `evaluate` wrote."""
    quiet: bool = False
    """Say nothing but errors."""


def run_report(options: ReportOptions) -> None:
    """Write `report.html` anew and say where it lies.

    Raises:
        InputError: where the folder holds no results, or damaged ones.
    """
    # Here, so that `--help` does not wait for torch.
    from gscompleter.reports.completion_page import completion_page
    from gscompleter.reports.evaluation_page import TABLES, evaluation_page
    from gscompleter.reports.page import NAME, write_page

    evaluated = os.path.isfile(options.out / TABLES)
    page = evaluation_page(options.out) if evaluated else completion_page(options.out)
    write_page(options.out, page)
    if not options.quiet:
        print(options.out / NAME)
