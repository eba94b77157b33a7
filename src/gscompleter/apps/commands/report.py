"""The command `report`: write the report page again."""

from __future__ import annotations

import os

from gscompleter.apps.commands.options import ReportOptions
from gscompleter.apps.report.completion_page import render_completion_page
from gscompleter.apps.report.evaluation_page import TABLES_FILE, render_evaluation_page
from gscompleter.apps.report.page import REPORT_FILE, write_page


def run_report(options: ReportOptions) -> None:
    """Write `report.html` and print its path."""
    evaluated = os.path.isfile(options.out / TABLES_FILE)
    page = render_evaluation_page(options.out) if evaluated else render_completion_page(options.out)
    write_page(options.out, page)
    if not options.quiet:
        print(options.out / REPORT_FILE)
