"""The command `report`: write the report page again."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.config.settings import Settings


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Settings):
    """Write report.html of a completion or an evaluation again."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output folder of `complete`, `demo` or `evaluate`."""
    quiet: bool = False
    """Print errors only."""


def run_report(options: ReportOptions) -> None:
    """Write `report.html` and print its path."""
    # Imported here so that `--help` does not wait for torch.
    from gscompleter.apps.report.completion_page import render_completion_page
    from gscompleter.apps.report.evaluation_page import TABLES_FILE, render_evaluation_page
    from gscompleter.apps.report.page import REPORT_FILE, write_page

    evaluated = os.path.isfile(options.out / TABLES_FILE)
    page = render_evaluation_page(options.out) if evaluated else render_completion_page(options.out)
    write_page(options.out, page)
    if not options.quiet:
        print(options.out / REPORT_FILE)
