"""The command `report`: write the page of a completion again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.commands.shared_options import Options
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Options):
    """Write report.html of a completion again.

    Example: gscompleter report result
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output folder of `complete` or `demo`."""


def run_report(options: ReportOptions) -> None:
    """Write `report.html` and print its path."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.report.page import REPORT_FILE, write_completion_page
    write_completion_page(options.out)
    path = options.out / REPORT_FILE
    print_answer(options.answer, {"report": str(path)}, [path])
