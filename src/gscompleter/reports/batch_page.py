"""The table and the page on a batch, made of its rows."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median
from typing import Any

from PIL import Image

from gscompleter.batch.jobs import JOBS, THUMBNAILS, Job, read_row
from gscompleter.batch.places import Place
from gscompleter.errors import InputError
from gscompleter.io.image import jpeg_of, read_pixels
from gscompleter.reports.page import NAME, QUALITY, Picture, rendered
from gscompleter.reports.plain_words import shown

INDEX, TABLE = "index.html", "table.csv"
"""The page and the table of a batch."""
HEIGHT = 96
"""Pixels of the pictures of a job on the page."""
PICTURES = 1_000
"""Jobs of which the page shows pictures, about 5 MB; of the others it has rows."""
COLUMNS = (
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
"""Of the table."""
HEAD = ("PSNR before", "PSNR after", "covered before", "covered after", "added", "seconds")
"""Of the table on the page, after the name of the job."""
WHEN = ("before", "after")
"""How the names of the pictures of a target end."""


@dataclass(frozen=True)
class Shown:
    """A job on the page that is done."""

    name: str
    cells: tuple[str, ...]
    link: str
    """Where its own page lies, relative to this one."""
    picture: Picture | None


def scores_of(summary: Mapping[str, Any]) -> dict[str, Any]:
    """What the row of a completion says of it; means over its targets."""
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


def thumbnail_of(folder: Path) -> bytes | None:
    """The first target before and after, side by side, as a JPEG; None where there is none."""
    try:
        pair = [read_pixels(folder / "images" / f"target1_{when}.png") for when in WHEN]
    except InputError:
        return None
    small = [sized(Image.fromarray(pixels)) for pixels in pair]
    both = Image.new("RGB", (sum(image.width for image in small) + 4, HEIGHT), "white")
    both.paste(small[0], (0, 0))
    both.paste(small[1], (small[0].width + 4, 0))
    return jpeg_of(both, QUALITY)


def sized(image: Image.Image) -> Image.Image:
    """`image` as high as those on the page."""
    width = max(1, round(image.width * HEIGHT / image.height))
    return image.resize((width, HEIGHT), Image.Resampling.LANCZOS)


def write_overview(place: Place, jobs: Sequence[Job]) -> None:
    """Write the table and the page on the rows of `jobs`.

    Raises:
        OutputError: where they cannot be written.
    """
    rows = [row for job in jobs if (row := read_row(place, job.name)) is not None]
    place.write(TABLE, table_of(rows).encode())
    place.write(INDEX, page_of(rows, lambda name: picture_of(place, name)).encode())


def table_of(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows as CSV."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def page_of(rows: Sequence[Mapping[str, Any]], picture: Callable[[str], Picture | None]) -> str:
    """The page on rows."""
    good = [row for row in rows if row["state"] == "done"]
    bad = [f"{row['job']}: {row['reason']}" for row in rows if row["state"] == "failed"]
    return rendered(
        "batch.html",
        {
            "facts": facts_of(good, len(bad)),
            "failures": bad,
            "jobs": [
                shown_job(row, picture(row["job"]) if number < PICTURES else None)
                for number, row in enumerate(good)
            ],
            "head": HEAD,
            "table": TABLE,
        },
    )


def facts_of(good: Sequence[Mapping[str, Any]], failed: int) -> list[tuple[str, str]]:
    """The head of the page."""
    gains = [r["psnr_after"] - r["psnr_before"] for r in good if r["psnr_after"] is not None]
    seconds = [row["seconds"] for row in good]
    return [
        ("done", str(len(good))),
        ("failed", str(failed)),
        ("median gain", f"{shown(median(gains))} dB" if gains else "–"),
        ("median time", f"{shown(median(seconds))} s" if seconds else "–"),
        ("time of all", f"{shown(sum(seconds) / 3600)} h" if seconds else "–"),
    ]


def shown_job(row: Mapping[str, Any], picture: Picture | None) -> Shown:
    """A row on the page, of a job that is done."""

    def share(key: str) -> str:
        return "–" if row.get(key) is None else f"{100 * row[key]:.1f} %"

    cells = (
        shown(row.get("psnr_before")),
        shown(row.get("psnr_after")),
        share("coverage_before"),
        share("coverage_after"),
        f"{row['added']:,}" if row.get("added") is not None else "–",
        shown(row.get("seconds")),
    )
    return Shown(row["job"], cells, f"{JOBS}/{row['job']}/{NAME}", picture)


def picture_of(place: Place, name: str) -> Picture | None:
    """The picture of a job, inside of the page; None where it has none."""
    content = place.read(f"{THUMBNAILS}/{name}.jpg")
    if content is None:
        return None
    with Image.open(io.BytesIO(content)) as image:
        width, height = image.size
    uri = f"data:image/jpeg;base64,{base64.b64encode(content).decode()}"
    return Picture(f"{name}, before and after", width, height, uri)
