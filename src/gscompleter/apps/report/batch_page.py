"""The table and the page of a batch."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Any

from PIL import Image

from gscompleter.apps.report.page import (
    JPEG_QUALITY,
    REPORT_FILE,
    Picture,
    encode_uri,
    render_template,
)
from gscompleter.errors import InputError
from gscompleter.io.image import encode_jpeg, read_pixels
from gscompleter.jobs.jobs import JOBS, THUMBNAILS, Job, read_row
from gscompleter.jobs.places import Place

INDEX_FILE, TABLE_FILE = "index.html", "table.csv"
THUMBNAIL_HEIGHT = 96
MAX_THUMBNAILS = 1_000
"""Largest number of jobs with thumbnails on the page (about 5 MB)."""
TABLE_COLUMNS = (
    "job",
    "state",
    "reason",
    "attempts",
    "targets",
    "hole_fraction",
    "psnr_before",
    "psnr_after",
    "coverage_before",
    "coverage_after",
    "added",
    "seconds",
    "cpu_seconds",
    "read_bytes",
    "written_bytes",
    "result_bytes",
    "peak_bytes",
)
IMAGE_ENDINGS = ("before", "after")


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


def make_batch_thumbnail(folder: Path) -> bytes | None:
    """Join the first target before and after as a JPEG, or return None without images."""
    try:
        pair = [read_pixels(folder / "images" / f"target1_{when}.png") for when in IMAGE_ENDINGS]
    except InputError:
        return None
    small = [resize_thumbnail(Image.fromarray(pixels)) for pixels in pair]
    both = Image.new("RGB", (sum(image.width for image in small) + 4, THUMBNAIL_HEIGHT), "white")
    both.paste(small[0], (0, 0))
    both.paste(small[1], (small[0].width + 4, 0))
    return encode_jpeg(both, JPEG_QUALITY)


def resize_thumbnail(image: Image.Image) -> Image.Image:
    """Resize an image to the height of a thumbnail."""
    width = max(1, round(image.width * THUMBNAIL_HEIGHT / image.height))
    return image.resize((width, THUMBNAIL_HEIGHT), Image.Resampling.LANCZOS)


def write_overview(place: Place, jobs: Sequence[Job]) -> None:
    """Write the table and the page of `jobs`."""
    rows = [row for job in jobs if (row := read_row(place, job.name)) is not None]
    place.write(TABLE_FILE, format_csv(rows).encode())
    place.write(
        INDEX_FILE, render_batch_page(rows, lambda name: read_thumbnail(place, name)).encode()
    )


def format_csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """Format rows as CSV."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, TABLE_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def render_batch_page(
    rows: Sequence[Mapping[str, Any]], find_picture: Callable[[str], Picture | None]
) -> str:
    """Render the page of a batch."""
    good = [row for row in rows if row["state"] == "done"]
    gains = [r["psnr_after"] - r["psnr_before"] for r in good if r["psnr_after"] is not None]
    seconds = [row["seconds"] for row in good]
    return render_template(
        "batch.html",
        {
            "jobs": [
                (row, find_picture(row["job"]) if number < MAX_THUMBNAILS else None)
                for number, row in enumerate(good)
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


def read_thumbnail(place: Place, name: str) -> Picture | None:
    """Read the thumbnail of a job as a data URI, or return None."""
    content = place.read(f"{THUMBNAILS}/{name}.jpg")
    if content is None:
        return None
    with Image.open(io.BytesIO(content)) as image:
        width, height = image.size
    uri = encode_uri("image/jpeg", content)
    return Picture(f"{name}, before and after", width, height, uri)
