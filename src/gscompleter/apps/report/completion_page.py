"""The report page of a completion, made from its output folder alone."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from gscompleter import __version__
from gscompleter.apps.report.charts import (
    Plot,
    fit_drawing,
    make_palette,
    plot_depth_pairs,
    plot_loss,
)
from gscompleter.apps.report.page import Gallery, Picture, Slider, open_gallery, render_template
from gscompleter.apps.report.plain_words import describe_alignment, list_scene_notes
from gscompleter.apps.report.schema import (
    SCORES,
    CompletionSummary,
    ScoreRow,
    TargetRecord,
    TargetRow,
    read_record,
    read_summary,
)
from gscompleter.data.formats import FORMATS
from gscompleter.kernels.parallel import map_in_parallel

VIEWER_FILE = "view.html"
IMAGE_CAPTIONS = {
    "reference": "Reference: the synthesized image",
    "hole_mask": "Hole mask (white: hole)",
    "support": "Trust: agreement of the scene with the photographs (white: full)",
    "truth": "Photograph, used for scores only",
}
CURVE_CAPTIONS = {
    "register": "Loss of the registration along the rays",
    "refine": "Loss of the refinement",
}
NUM_SCALE_COLORS = 16


@dataclass(frozen=True)
class TargetSection:
    """Content of the page about one target."""

    row: TargetRow
    record: TargetRecord
    images: Slider
    pictures: Sequence[tuple[Picture, str]]
    depths: Slider | None
    fit: str
    plots: Sequence[tuple[Plot, str]]
    """Loss curves with captions."""
    scatter: Plot | None


def render_completion_page(folder: Path) -> str:
    """Render the page of the completion in `folder`.

    Raises:
        InputError: if the folder has no completion, a damaged one, or one of another version.
    """
    summary = read_summary(folder, __version__)
    record, unit = read_record(folder, summary), find_length_unit(summary)
    gallery = open_gallery(folder / "images")

    def build(number: int, row: TargetRow, kept: TargetRecord) -> TargetSection:
        return build_section(number, row, kept, gallery, unit)

    path = summary.scene.splat or str(summary.settings.get("folder") or "")
    numbers = range(1, len(summary.targets) + 1)
    return render_template(
        "completion.html",
        {
            "title": Path(path).name or "Scene",
            "summary": summary,
            "record": record,
            "notes": list_scene_notes(summary),
            "targets": map_in_parallel(build, numbers, summary.targets, record.targets),
            "around": [
                gallery.embed_slider(f"around{n}", f"Camera {n} around the photographs")
                for n in range(1, len(record.around) + 1)
            ],
            "ignored": list(embed_ignored_images(summary, gallery)),
            "drawing": fit_drawing(record),
            "unit": unit,
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


def build_section(
    number: int, row: TargetRow, record: TargetRecord, gallery: Gallery, unit: str
) -> TargetSection:
    """Build the section of a target."""
    name, fit, pairs = f"target{number}", row.affine, record.pairs
    depths = None
    if record.depth_limits is not None:
        depths = gallery.embed_slider(f"{name}_depth", f"Depth at target {number}", exact=True)
    plots = [(plot_loss(c, record.losses.get(k, ())), c) for k, c in CURVE_CAPTIONS.items()]
    return TargetSection(
        row,
        record,
        images=gallery.embed_slider(name, f"Target {number}, {row.name}"),
        pictures=list(embed_target_images(number, row, gallery)),
        depths=depths,
        fit=describe_alignment(fit, unit),
        plots=[(plot, caption) for plot, caption in plots if plot is not None],
        scatter=None if pairs is None else plot_depth_pairs(pairs, fit.scale, fit.shift, unit),
    )


def embed_target_images(
    number: int, row: TargetRow, gallery: Gallery
) -> Iterator[tuple[Picture, str]]:
    """Embed the images of a target other than before and after."""
    for name, caption in IMAGE_CAPTIONS.items():
        file = f"target{number}_{name}.png"
        expected = name == "hole_mask" or (name == "truth" and row.psnr_after is not None)
        if expected or (gallery.folder / file).is_file():
            exact = name in ("hole_mask", "support")
            yield gallery.embed(file, f"{caption}, at target {number}", exact), caption


def embed_ignored_images(
    summary: CompletionSummary, gallery: Gallery
) -> Iterator[tuple[Picture, str]]:
    """Embed the photographs that have ignored pixels."""
    for number, row in enumerate(summary.context, start=1):
        if row.ignored > 0:
            caption = f"Photograph {row.frame}: {row.ignored:.1%} of the image is ignored (magenta)"
            yield gallery.embed(f"context{number}_ignored.png", caption), caption


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
        "near": summary.depth_range.near,
        "far": summary.depth_range.far,
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
