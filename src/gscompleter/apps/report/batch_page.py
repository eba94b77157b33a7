"""The table and the page of a batch."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Any

from gscompleter.apps.report.page import REPORT_FILE, Gallery, Picture, render_template
from gscompleter.errors import InputError
from gscompleter.io.files import replace_file
from gscompleter.io.image import read_image_size
from gscompleter.jobs.jobs import JOBS, Job, read_row

INDEX_FILE, TABLE_FILE = "index.html", "table.csv"
THUMBNAIL_HEIGHT = 96
MAX_THUMBNAILS = 1_000
"""Largest number of jobs with thumbnails on the page (about 5 MB)."""
TABLE_COLUMNS = (
    *("job", "state", "reason", "attempts"),
    *("targets", "hole_fraction", "psnr_before", "psnr_after"),
    *("coverage_before", "coverage_after", "added"),
    *("seconds", "cpu_seconds", "result_bytes", "peak_bytes"),
)


def average_scores(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Average the scores of a completion over its targets."""
    targets = summary["targets"]

    def mean(key: str) -> float | None:
        values = [t[key] for t in targets if t[key] is not None]
        return fmean(values) if values else None

    return {
        "targets": len(targets),
        "hole_fraction": mean("hole_fraction"),
        "psnr_before": mean("psnr_before"),
        "psnr_after": mean("psnr_after"),
        "coverage_before": summary["coverage"]["before"],
        "coverage_after": summary["coverage"]["after"],
        "added": summary["gaussians"]["added"],
    }


def write_overview(out: Path, jobs: Sequence[Job]) -> None:
    """Write the table and the page of `jobs`."""
    rows = [row for job in jobs if (row := read_row(job, out)) is not None]
    texts = {TABLE_FILE: format_csv(rows), INDEX_FILE: render_batch_page(out, rows)}
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


def render_batch_page(out: Path, rows: Sequence[Mapping[str, Any]]) -> str:
    """Render the page of a batch."""
    good = [row for row in rows if row["state"] == "done"]
    gains = [r["psnr_after"] - r["psnr_before"] for r in good if r["psnr_after"] is not None]
    seconds = [row["seconds"] for row in good]
    return render_template(
        "batch.html",
        {
            "jobs": [
                (row, embed_thumbnails(out / JOBS / row["job"]) if n < MAX_THUMBNAILS else [])
                for n, row in enumerate(good)
            ],
            "failures": [f"{r['job']}: {r['reason']}" for r in rows if r["state"] == "failed"],
            "gain": median(gains) if gains else None,
            "seconds": median(seconds) if seconds else None,
            "hours": sum(seconds) / 3600,
            "folder": JOBS,
            "report": REPORT_FILE,
            "table": TABLE_FILE,
        },
    )


def embed_thumbnails(folder: Path) -> list[Picture]:
    """Embed the first target of a completion before and after; none if an image is missing."""
    images = folder / "images"
    try:
        _, height = read_image_size(images / "target1_before.png")
    except InputError:
        return []
    gallery = Gallery(images, min(1.0, THUMBNAIL_HEIGHT / height))
    return [gallery.embed(f"target1_{w}", f"{folder.name}, {w}") for w in ("before", "after")]
