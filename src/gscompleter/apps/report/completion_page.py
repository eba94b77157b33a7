"""The report page of a completion, made from its output folder alone."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from gscompleter import __version__
from gscompleter.apps.report.charts import fit_drawing, make_palette, plot_depth_pairs, plot_loss
from gscompleter.apps.report.page import open_gallery, render_template
from gscompleter.apps.report.plain_words import describe_alignment, list_scene_notes
from gscompleter.apps.report.schema import (
    SCORES,
    CompletionSummary,
    ScoreRow,
    read_record,
    read_summary,
)
from gscompleter.data.formats import FORMATS

VIEWER_FILE = "view.html"
NUM_SCALE_COLORS = 16


def render_completion_page(folder: Path) -> str:
    """Render the page of the completion in `folder`.

    Raises:
        InputError: if the folder has no completion, a damaged one, or one of another version.
    """
    summary = read_summary(folder, __version__)
    record = read_record(folder, summary)
    path = summary.scene.splat or str(summary.settings.get("folder") or "")
    return render_template(
        "completion.html",
        {
            "title": Path(path).name or "Scene",
            "summary": summary,
            "record": record,
            "gallery": open_gallery(folder / "images"),
            "notes": list_scene_notes(summary),
            "describe_alignment": describe_alignment,
            "plot_depth_pairs": plot_depth_pairs,
            "plot_loss": plot_loss,
            "drawing": fit_drawing(record),
            "unit": find_length_unit(summary),
            "palette": list_scale_colors(),
            "mean_held_out": average_scores(summary.held_out),
            "seconds": {name: s for name, s in summary.seconds.items() if name != "total"},
            "settings": list_settings(summary),
            "viewer": VIEWER_FILE if os.path.isfile(folder / VIEWER_FILE) else None,
        },
    )


def find_length_unit(summary: CompletionSummary) -> str:
    """Return metres if the format defines them and the splat has no frame of its own."""
    format = FORMATS.get(summary.scene.format)
    known = format is not None and format.unit is not None and summary.frame.method == "given"
    return str(format.unit) if format is not None and known else "scene units"


def list_scale_colors() -> list[str]:
    """List CSS colours of depths from near to far."""
    palette = make_palette()[1 :: len(make_palette()) // NUM_SCALE_COLORS]
    return ["#{:02x}{:02x}{:02x}".format(*colour) for colour in palette.tolist()]


def average_scores(rows: Sequence[ScoreRow]) -> ScoreRow:
    """Average each score over the rows that have it."""
    known = {name: [v for row in rows if (v := getattr(row, name)) is not None] for name in SCORES}
    return ScoreRow(None, **{name: fmean(v) if v else None for name, v in known.items()})


def list_settings(summary: CompletionSummary) -> list[tuple[str, str]]:
    """List all settings and what was found in the input."""
    found = {
        "version": summary.version,
        "format": summary.scene.format,
        "near": summary.depth_range["near"],
        "far": summary.depth_range["far"],
        "seed": summary.seed,
        "device": summary.device,
    }
    return list(flatten_settings({"settings": summary.settings, "found": found}))


def flatten_settings(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Flatten nested settings to dotted names with values as JSON."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flatten_settings(value, f"{prefix}{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            yield f"{prefix}{name}", "–" if value is None else text
