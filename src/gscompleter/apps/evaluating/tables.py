"""Tables of an evaluation, written and printed."""

from __future__ import annotations

import json
from pathlib import Path

from rich.table import Table

from gscompleter.apps.command_line.answers import print_json
from gscompleter.evaluation import tables
from gscompleter.evaluation.store import list_row_paths
from gscompleter.evaluation.tables import RunSummary
from gscompleter.system.console import make_console
from gscompleter.system.progress import show_preparation


def write_and_print_tables(
    out: Path,
    quiet: bool,
    with_fid: bool = False,
    num_rows: int = 0,
    as_json: bool = False,
) -> None:
    """Write the tables of an evaluation, and print them as JSON, or as tables unless `quiet`.

    It repeats this if other shards added rows meanwhile and all `num_rows` are there.
    """
    # Several shards may end together, and each writes the tables. The one that saw all rows writes
    # again until no row changed while it wrote, so that the tables that remain are complete.
    written = None
    rows = list_row_times(out)
    while written is None or (rows != written and len(rows) >= num_rows):
        written = rows
        with show_preparation("tables"):
            summary = tables.write_tables(out, with_fid)
        rows = list_row_times(out)
    if as_json:
        print_json(json.loads((out / "tables.json").read_bytes()))
    elif not quiet:
        print_tables(summary, out)


def list_row_times(out: Path) -> dict[Path, int]:
    """List the files of scores with their modification times, in nanoseconds."""
    return {path: path.stat().st_mtime_ns for path in list_row_paths(out)}


def print_tables(summary: RunSummary, out: Path) -> None:
    """Print the tables, transposed: one column per method."""
    table = Table("", *summary.methods, box=None)
    cells = tables.format_score_cells(summary, summary.columns)
    for number, column in enumerate(summary.columns, start=1):
        table.add_row(column.title, *(row[number] for row in cells))

    # Seconds compare methods, so they are those of the cases that all of them completed.
    if summary.common_tasks:
        seconds = [summary.compute_seconds(method)["total"] for method in summary.methods]
        table.add_row("seconds", *(f"{total:.1f}" for total in seconds))
    console = make_console()
    console.print(table)
    for case, method, reason in summary.failures:
        console.print(f"Failed: {case}, {method}: {reason}", soft_wrap=True)
    over = f"Over {len(summary.common_tasks)} of {len(summary.tasks)} cases"
    console.print(f"{over}: {out / 'tables.md'}", soft_wrap=True)
