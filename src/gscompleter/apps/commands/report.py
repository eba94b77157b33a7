"""The command `report`: write the report page again."""

from __future__ import annotations

from gscompleter.apps.commands.options import ReportOptions
from gscompleter.apps.report.page import REPORT_FILE, write_completion_page


def run_report(options: ReportOptions) -> None:
    """Write `report.html` and print its path."""
    write_completion_page(options.out)
    if not options.quiet:
        print(options.out / REPORT_FILE)
