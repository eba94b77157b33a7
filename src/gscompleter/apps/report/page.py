"""HTML pages of a completion and of a batch: one file with style and script.

The page of a completion embeds its images; that of a batch shows those of the jobs, which lie
beside it. Templates escape all text. A content security policy blocks all other requests and
scripts.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from gscompleter import __version__
from gscompleter.apps.report.plain_words import (
    describe_alignment,
    group_target_warnings,
    list_facts,
    list_warnings,
)
from gscompleter.apps.report.schema import SCORES, CompletionSummary, read_record, read_summary
from gscompleter.data.formats import SCENE_FORMATS
from gscompleter.evaluation.verdict.numbers import (
    average,
    format_change,
    format_number,
    format_percent,
)
from gscompleter.evaluation.verdict.rows import CHECK_USE, NO_USE, ScoreRow
from gscompleter.system.files.image import (
    SHOWN_JPEG_QUALITY,
    encode_jpeg,
    read_image_size,
    read_pixels,
)
from gscompleter.system.files.output_folder import refuse_foreign_file
from gscompleter.system.files.result_names import SUMMARY_FILE
from gscompleter.system.files.text import encode_text
from gscompleter.system.files.writing import replace_file
from gscompleter.system.jobs.jobs import JOBS, Job, read_row

# Files of a completion: its page, and the viewer with its scene inside, which is optional.
REPORT_FILE = "report.html"
VIEWER_FILE = "view.html"
# Files of a batch: its page, and the table of all jobs.
INDEX_FILE = "index.html"
TABLE_FILE = "table.csv"

MAX_LISTED = 2000
"""Most jobs, and most failures, on the page of a batch, which a browser opens at once; the table
has all."""
TARGET_COLUMNS = ("hole_fraction", "psnr_before", "psnr_after")
"""Columns of the table that are means over the targets of a job."""
TABLE_COLUMNS = (
    *("job", "state", "reason", "attempts", "outcome", "headline"),
    *("unused_before", "unused_after"),
    *("targets", *TARGET_COLUMNS),
    *("coverage_before", "coverage_after", "added"),
    *("seconds", "cpu_seconds", "result_bytes", "peak_bytes"),
)
"""Columns of the table: entries of the rows of jobs, by their names."""
SETTINGS = ("version", "device", "seed", "depth_range", "settings")
"""Entries of `summary.json` that the page lists as settings."""
MAX_PAGE_PIXELS = 12_000_000
"""Largest sum of the pixels of all images in a page (about 5 MB); larger ones are scaled down."""


@dataclass(frozen=True)
class Picture:
    """An embedded image: its text for those who do not see it, its size in pixels, and its data."""

    alt: str
    width: int
    height: int
    uri: str


@dataclass(frozen=True)
class Gallery:
    """PNG images of a folder, embedded at one scale; names are those of files without ending."""

    folder: Path
    scale: float = 1.0

    def embed(self, name: str, alt: str) -> Picture:
        """Embed an image as a JPEG; raise an InputError if it is missing or damaged."""
        image = Image.fromarray(read_pixels(self.folder / f"{name}.png"))
        if self.scale < 1:
            width = max(1, round(self.scale * image.width))
            height = max(1, round(self.scale * image.height))
            image = image.resize((width, height), Image.Resampling.LANCZOS)
        content = base64.b64encode(encode_jpeg(image, SHOWN_JPEG_QUALITY)).decode()
        return Picture(alt, *image.size, f"data:image/jpeg;base64,{content}")

    def has(self, name: str) -> bool:
        """Return True if there is an image of this name."""
        return (self.folder / f"{name}.png").is_file()


def open_gallery(folder: Path) -> Gallery:
    """Choose a scale at which all images of `folder` fit into a page."""
    sizes = [read_image_size(path) for path in folder.glob("*.png")]
    pixels = sum(width * height for width, height in sizes)
    # Pixels grow with the square of the scale.
    return Gallery(folder, min(1.0, (MAX_PAGE_PIXELS / max(pixels, 1)) ** 0.5))


def render_template(template: str, values: Mapping[str, object]) -> str:
    """Render a template with `values`, style and script."""
    environment = create_environment()
    script = environment.get_template("script.js").render()
    # The content security policy names the hash of the only script that may run.
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    shared = {"version": __version__, "script": Markup(script), "digest": digest}
    return environment.get_template(template).render(**shared, **values)


@cache
def create_environment() -> Environment:
    """Create the template environment: escapes all text, refuses unknown names."""
    environment = Environment(
        loader=PackageLoader(__package__),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": format_number,
        "percent": format_percent,
        "change": format_change,
        "count": "{:,}".format,
    }
    return environment


def write_completion_page(folder: Path) -> None:
    """Write `report.html` of the completion in `folder`; replace only a page that a run wrote."""
    page = render_completion_page(folder)
    refuse_foreign_file(folder, REPORT_FILE)
    with replace_file(folder / REPORT_FILE) as file:
        file.write(encode_text(page))


def render_completion_page(folder: Path) -> str:
    """Render the page of the completion in `folder`."""
    summary = read_summary(folder)
    # Warnings of several targets are in `list_warnings`, once for all; a target has the others.
    groups = group_target_warnings(summary.targets)
    own_warnings = [
        row.warnings if len(groups.get(row.warnings, ())) == 1 else () for row in summary.targets
    ]

    path = summary.scene.splat or str(summary.settings.get("folder") or "")
    settings = {name: getattr(summary, name) for name in SETTINGS}
    return render_template(
        "completion.html",
        {
            "title": Path(path).name or "Scene",
            "summary": summary,
            "record": read_record(folder, summary),
            "gallery": open_gallery(folder / "images"),
            "warnings": list(list_warnings(summary)),
            "facts": list_facts(summary),
            "own_warnings": own_warnings,
            "photographs": list_photographs(summary),
            "describe_alignment": describe_alignment,
            "unit": find_length_unit(summary),
            "mean_held_out": {
                key: average(getattr(r, key) for r in summary.held_out)
                for key in (*SCORES, "covered_before", "covered_after")
            },
            "seconds": {name: s for name, s in summary.seconds.items() if name != "total"},
            "settings": json.dumps(settings, indent=2, ensure_ascii=False),
            "viewer": VIEWER_FILE if os.path.isfile(folder / VIEWER_FILE) else None,
        },
    )


def list_photographs(summary: CompletionSummary) -> list[tuple[str, ScoreRow, str]]:
    """List the photographs of a page without targets: how names of its images begin, row and use.

    The images are numbered in the order in which `make_writing_draw` was given the photographs.
    """
    if summary.targets:
        return []
    used = [(row, "used") for row in summary.context]
    checks = [(row, CHECK_USE) for row in summary.checks]
    held_out = [(row, row.use) for row in summary.held_out]
    numbered = enumerate([*used, *checks, *held_out], start=1)
    # Of a check that also scores the result, the score at full size is shown.
    scoring = {row.frame for row in summary.held_out}
    small = [row for row in summary.checks if row.frame in scoring]
    listed = [
        (f"photograph{number}", row, use) for number, (row, use) in numbered if row not in small
    ]
    # Those that were not used come first, since they test the result; the sort is stable.
    return sorted(listed, key=lambda photograph: photograph[2] != NO_USE)


def find_length_unit(summary: CompletionSummary) -> str:
    """Return the unit of lengths: that of the format, such as metres, or else "scene units".

    A splat with a frame of its own, which the photographs were aligned to, has its own unit.
    """
    scene_format = SCENE_FORMATS.get(summary.scene.format)
    has_own_unit = summary.frame.method != "given"
    if scene_format is None or scene_format.unit is None or has_own_unit:
        return "scene units"
    return str(scene_format.unit)


def average_scores(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Average the scores of a completion, as columns of the table of a batch.

    They are means over photographs that were not used and over targets, None without any; coverage
    and the number of added Gaussians are of the whole completion.
    """
    targets = summary["targets"]
    # A photograph has scores where the completed scene covers it.
    unused = [row for row in summary["held_out"] if row["psnr_after"] is not None]
    return {
        "unused_before": average(row["psnr_before"] for row in unused),
        "unused_after": average(row["psnr_after"] for row in unused),
        "targets": len(targets),
        **{key: average(target[key] for target in targets) for key in TARGET_COLUMNS},
        "coverage_before": summary["coverage"]["before"],
        "coverage_after": summary["coverage"]["after"],
        "added": summary["gaussians"]["added"],
    }


def write_overview(out: Path, jobs: Sequence[Job]) -> None:
    """Write the table and the page of those of `jobs` that have a row, into `out`."""
    found_rows = [read_row(job, out) for job in jobs]
    rows = [row for row in found_rows if row is not None]
    texts = {TABLE_FILE: format_csv(rows), INDEX_FILE: render_batch_page(out, rows)}
    for name, text in texts.items():
        with replace_file(out / name) as file:
            file.write(encode_text(text))


def format_csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """Format rows as CSV, with the columns `TABLE_COLUMNS`; what a row lacks is empty."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, TABLE_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def render_batch_page(out: Path, rows: Sequence[Mapping[str, Any]]) -> str:
    """Render the page of the batch in `out`; `rows` are those of its jobs, done or failed."""
    good = [row for row in rows if row["state"] == "done"]
    bad = [row for row in rows if row["state"] == "failed"]
    without_gain = [row for row in good if row.get("outcome") == "nothing-gained"]
    seconds = [row["seconds"] for row in good]
    return render_template(
        "batch.html",
        {
            "counts": {
                "completed": len(good) - len(without_gain),
                "nothing gained": len(without_gain),
                "failed": len(bad),
            },
            "jobs": [{**dict.fromkeys(TABLE_COLUMNS), **row} for row in good[:MAX_LISTED]],
            "done": len(good),
            "failures": bad[:MAX_LISTED],
            "reported": {
                row["job"]
                for row in bad[:MAX_LISTED]
                if reports_failure(out / JOBS / row["job"], row["reason"])
            },
            "gains": {
                "at unused photographs": find_median_gain(good, "unused"),
                "at targets": find_median_gain(good, "psnr"),
            },
            "seconds": round(median(seconds)) if seconds else None,
            "hours": sum(seconds) / 3600,
            "folder": JOBS,
            "report": REPORT_FILE,
            "table": TABLE_FILE,
        },
    )


def reports_failure(folder: Path, reason: str) -> bool:
    """Return True if a failed job left a page to look at: its scene did not reconstruct.

    The folder of another failure may hold the page of an earlier run, with other options.
    """
    if not os.path.isfile(folder / REPORT_FILE):
        return False
    try:
        summary = json.loads((folder / SUMMARY_FILE).read_bytes())
        return bool(summary["outcome"]["headline"] == reason)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def find_median_gain(rows: Sequence[Mapping[str, Any]], score: str) -> float | None:
    """Return the median gain in dB over the jobs with a score, or None.

    `score` names its columns without the endings `_before` and `_after`.
    """
    gains = []
    for row in rows:
        before, after = row.get(f"{score}_before"), row.get(f"{score}_after")
        if before is not None and after is not None:
            gains.append(after - before)
    return median(gains) if gains else None
