"""The report page of a completion, made from its output folder alone."""

from __future__ import annotations

import json
import os
from pathlib import Path

from gscompleter.apps.report.page import REPORT_FILE, open_gallery, render_template
from gscompleter.apps.report.plain_words import describe_alignment, list_notes
from gscompleter.apps.report.schema import (
    SCORES,
    CompletionSummary,
    average,
    read_record,
    read_summary,
)
from gscompleter.data.formats import FORMATS
from gscompleter.io.files import replace_file

VIEWER_FILE = "view.html"


def write_completion_page(folder: Path) -> None:
    """Write `report.html` of the completion in `folder`."""
    page = render_completion_page(folder)
    with replace_file(folder / REPORT_FILE) as file:
        file.write(page.encode())


def render_completion_page(folder: Path) -> str:
    """Render the page of the completion in `folder`."""
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
            "unit": find_length_unit(summary),
            "mean_held_out": {
                key: average(getattr(r, key) for r in summary.held_out) for key in SCORES
            },
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


def format_settings(summary: CompletionSummary) -> str:
    """Format all settings, and what was found in the input, as JSON."""
    names = ("version", "device", "seed", "depth_range", "settings")
    values = {name: getattr(summary, name) for name in names}
    return json.dumps(values, indent=2, ensure_ascii=False)
