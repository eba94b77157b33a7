"""The report page of a completion, made from its output folder alone."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from gscompleter.apps.report.charts import plot_depth_pairs
from gscompleter.apps.report.page import open_gallery, render_template
from gscompleter.apps.report.plain_words import describe_alignment, list_notes
from gscompleter.apps.report.schema import (
    SCORES,
    CompletionSummary,
    ScoreRow,
    read_record,
    read_summary,
)
from gscompleter.data.formats import FORMATS

VIEWER_FILE = "view.html"


def render_completion_page(folder: Path) -> str:
    """Render the page of the completion in `folder`.

    Raises:
        InputError: if the folder has no completion, or a damaged one.
    """
    summary = read_summary(folder)
    path = summary.scene.splat or str(summary.settings.get("folder") or "")
    return render_template(
        "completion.html",
        {
            "title": Path(path).name or "Scene",
            "summary": summary,
            "record": read_record(folder, summary),
            "gallery": open_gallery(folder / "images"),
            "notes": list(list_notes(summary)),
            "describe_alignment": describe_alignment,
            "plot_depth_pairs": plot_depth_pairs,
            "unit": find_length_unit(summary),
            "mean_held_out": average_scores(summary.held_out),
            "seconds": {name: s for name, s in summary.seconds.items() if name != "total"},
            "settings": format_settings(summary),
            "viewer": VIEWER_FILE if os.path.isfile(folder / VIEWER_FILE) else None,
        },
    )


def find_length_unit(summary: CompletionSummary) -> str:
    """Return metres if the format defines them and the splat has no frame of its own."""
    format = FORMATS.get(summary.scene.format)
    if format is None or format.unit is None or summary.frame.method != "given":
        return "scene units"
    return str(format.unit)


def average_scores(rows: Sequence[ScoreRow]) -> ScoreRow:
    """Average each score over the rows that have it."""
    known = {name: [v for row in rows if (v := getattr(row, name)) is not None] for name in SCORES}
    return ScoreRow(None, **{name: fmean(v) if v else None for name, v in known.items()})


def format_settings(summary: CompletionSummary) -> str:
    """Format all settings, and what was found in the input, as JSON."""
    names = ("version", "device", "seed", "depth_range", "settings")
    values = {name: getattr(summary, name) for name in names}
    return json.dumps(values, indent=2, ensure_ascii=False)
