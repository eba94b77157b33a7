"""The table and the page of a batch."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from gscompleter.apps.report.page import REPORT_FILE, render_template
from gscompleter.apps.report.schema import average
from gscompleter.io.files import replace_file
from gscompleter.jobs.jobs import JOBS, Job, read_row

INDEX_FILE, TABLE_FILE = "index.html", "table.csv"
TARGET_COLUMNS = ("hole_fraction", "psnr_before", "psnr_after")
TABLE_COLUMNS = (
    *("job", "state", "reason", "attempts"),
    *("targets", *TARGET_COLUMNS),
    *("coverage_before", "coverage_after", "added"),
    *("seconds", "cpu_seconds", "result_bytes", "peak_bytes"),
)


def average_scores(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Average the scores of a completion over its targets."""
    targets = summary["targets"]
    return {
        "targets": len(targets),
        **{key: average(target[key] for target in targets) for key in TARGET_COLUMNS},
        "coverage_before": summary["coverage"]["before"],
        "coverage_after": summary["coverage"]["after"],
        "added": summary["gaussians"]["added"],
    }


def write_overview(out: Path, jobs: Sequence[Job]) -> None:
    """Write the table and the page of `jobs`."""
    rows = [row for job in jobs if (row := read_row(job, out)) is not None]
    texts = {TABLE_FILE: format_csv(rows), INDEX_FILE: render_batch_page(rows)}
    for name, text in texts.items():
        with replace_file(out / name) as file:
            file.write(text.encode())


def format_csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """Format rows as CSV."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, TABLE_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def render_batch_page(rows: Sequence[Mapping[str, Any]]) -> str:
    """Render the page of a batch."""
    good = [row for row in rows if row["state"] == "done"]
    gains = [r["psnr_after"] - r["psnr_before"] for r in good if r["psnr_after"] is not None]
    seconds = [row["seconds"] for row in good]
    return render_template(
        "batch.html",
        {
            "jobs": good,
            "failures": [f"{r['job']}: {r['reason']}" for r in rows if r["state"] == "failed"],
            "gain": median(gains) if gains else None,
            "seconds": median(seconds) if seconds else None,
            "hours": sum(seconds) / 3600,
            "folder": JOBS,
            "report": REPORT_FILE,
            "table": TABLE_FILE,
        },
    )
