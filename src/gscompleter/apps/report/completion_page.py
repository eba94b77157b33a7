"""The report page of a completion, made from its output folder alone."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from markupsafe import Markup

from gscompleter.apps.report.camera_figure import PITCH, YAW, draw_cameras, label_cameras
from gscompleter.apps.report.figures import (
    draw_color_scale,
    draw_time_bars,
    plot_depth_scatter,
    plot_loss,
)
from gscompleter.apps.report.finished import (
    AlignmentRow,
    CompletionSummary,
    FinishedCompletion,
    ScoreRow,
    TargetRow,
    read_completion_folder,
)
from gscompleter.apps.report.page import (
    Gallery,
    Picture,
    Slider,
    Table,
    open_gallery,
    render_template,
)
from gscompleter.apps.report.plain_words import (
    format_change,
    format_number,
    format_percent,
    list_scene_notes,
    list_target_notes,
)
from gscompleter.apps.report.record import TargetRecord
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
ALIGNMENT_SENTENCES = {
    "ransac": "RANSAC fits scene depth = {scale} × lifted depth {shift}; {inliers} of the pixels "
    "agree",
    "median": "The median depth ratio is used: scene depth = {scale} × lifted depth; "
    "{inliers} of the pixels agree",
    "identity": "The lifted depths are used unchanged",
}
SCORE_COLUMNS = (
    "camera",
    "PSNR before",
    "PSNR after",
    "change",
    "SSIM before",
    "SSIM after",
    "change",
)


@dataclass(frozen=True)
class TargetSection:
    """Content of the page about one target."""

    number: int
    name: str
    images: Slider
    facts: Sequence[tuple[str, str]]
    notes: Sequence[str]
    link: str | None
    pictures: Sequence[tuple[Picture, str]]
    depths: Slider | None
    scale: Markup | None
    fit: str
    scatter: Markup | None
    seen_from: str
    curves: Sequence[tuple[Markup, str]]


def render_completion_page(folder: Path) -> str:
    """Render the page of the completion in `folder`.

    Raises:
        InputError: if the folder has no completion, a damaged one, or one of another version.
    """
    found = read_completion_folder(folder)
    summary, record = found.summary, found.record
    gallery, viewer = open_gallery(folder / "images"), find_viewer(folder)
    each = partial(build_section, gallery=gallery, unit=find_length_unit(summary), viewer=viewer)
    rows = list(enumerate(zip(summary.targets, record.targets, strict=True), start=1))
    return render_template(
        "completion.html",
        {
            "title": choose_title(summary),
            "facts": list_completion_facts(summary),
            "notes": list_scene_notes(summary),
            "targets": map_in_parallel(lambda row: each(row[0], *row[1]), rows),
            "coverage": describe_coverage(summary),
            "around": list(embed_surrounding_views(found, gallery)),
            "ignored": list(embed_ignored_images(summary, gallery)),
            "cameras": draw_completion_cameras(found),
            "cameras_caption": describe_cameras(found),
            "yaw": YAW,
            "pitch": PITCH,
            "scores": make_score_tables(summary),
            "bars": draw_time_bars("Seconds by stage", get_stage_seconds(summary)),
            "total": describe_total(summary),
            "settings": make_settings_table(summary),
            "viewer": viewer,
        },
    )


def find_viewer(folder: Path) -> str | None:
    """Return the address of the viewer's page if it exists."""
    return VIEWER_FILE if os.path.isfile(folder / VIEWER_FILE) else None


def choose_title(summary: CompletionSummary) -> str:
    """Choose the title: the name of the scene folder or of the input splat."""
    path = summary.scene.splat or str(summary.settings.get("folder") or "")
    return Path(path).name or "Scene"


def find_length_unit(summary: CompletionSummary) -> str:
    """Return metres if the format defines them and the splat has no frame of its own."""
    format = FORMATS.get(summary.scene.format)
    known = format is not None and format.unit is not None and summary.frame.method == "given"
    return str(format.unit) if format is not None and known else "scene units"


def list_completion_facts(summary: CompletionSummary) -> list[tuple[str, str]]:
    """List the numbers at the head of the page."""
    covered = summary.coverage
    facts = [
        (
            "covered around the photographs",
            f"{format_percent(covered.before)} → {format_percent(covered.after)}",
        ),
        ("Gaussians added", f"{summary.gaussians.get('added', 0):,}"),
        ("targets", str(len(summary.targets))),
        ("time", f"{format_number(summary.seconds.get('total'), 1)} s"),
    ]
    removed = summary.gaussians.get("removed")
    return facts if not removed else [*facts, ("Gaussians pruned", f"{removed:,}")]


def build_section(
    number: int, row: TargetRow, kept: TargetRecord, gallery: Gallery, unit: str, viewer: str | None
) -> TargetSection:
    """Build the section of a target."""
    name = f"target{number}"
    limits = kept.depth_limits
    return TargetSection(
        number=number,
        name=row.name,
        images=gallery.embed_slider(name, f"Target {number}, {row.name}"),
        facts=list_target_facts(row),
        notes=list_target_notes(row),
        link=None if viewer is None else f"{viewer}#camera=target-{number}",
        pictures=list(embed_target_images(number, row, gallery)),
        depths=None
        if limits is None
        else gallery.embed_slider(f"{name}_depth", f"Depth at target {number}", True),
        scale=None if limits is None else draw_color_scale(limits, unit),
        fit=describe_alignment(row.affine, unit),
        scatter=plot_depth_pairs(row.affine, kept, unit),
        seen_from="the anchor"
        if kept.pairs is None or kept.pairs.seen_from == "anchor"
        else "the target",
        curves=list(plot_losses(kept)),
    )


def list_target_facts(row: TargetRow) -> list[tuple[str, str]]:
    """List the numbers below the images of a target."""
    facts = [("hole", format_percent(row.hole_fraction)), ("Gaussians added", f"{row.added:,}")]
    if row.anchor is not None:
        facts.append(("anchor", f"photograph {row.anchor}"))
    if row.psnr_after is not None:
        facts.append(
            ("PSNR", f"{format_number(row.psnr_before)} → {format_number(row.psnr_after)} dB")
        )
        facts.append(
            ("SSIM", f"{format_number(row.ssim_before, 3)} → {format_number(row.ssim_after, 3)}")
        )
    return facts


def embed_target_images(
    number: int, row: TargetRow, gallery: Gallery
) -> Iterator[tuple[Picture, str]]:
    """Embed the images of a target other than before and after."""
    for name, caption in IMAGE_CAPTIONS.items():
        file = f"target{number}_{name}.png"
        expected = name == "hole_mask" or (name == "truth" and row.psnr_after is not None)
        if expected or (gallery.folder / file).is_file():
            embed = gallery.embed_exact if name in ("hole_mask", "support") else gallery.embed_photo
            yield embed(file, f"{caption}, at target {number}"), caption


def describe_alignment(affine: AlignmentRow, unit: str) -> str:
    """Describe the depth alignment of a target."""
    sign = "−" if affine.shift < 0 else "+"
    shift = f"{sign} {format_number(abs(affine.shift), 3)} {unit}"
    words = ALIGNMENT_SENTENCES.get(affine.method, "The depths are aligned by an unknown method")
    text = words.format(
        scale=format_number(affine.scale, 3), shift=shift, inliers=format_percent(affine.inliers, 0)
    )
    if affine.agreement is None:
        return f"{text}."
    return (
        f"{text}. At the target, {format_percent(affine.agreement, 0)} of the visible scene agree."
    )


def plot_depth_pairs(affine: AlignmentRow, kept: TargetRecord, unit: str) -> Markup | None:
    """Plot the depths that the alignment was fitted to, or return None without any."""
    if kept.pairs is None:
        return None
    pairs = zip(kept.pairs.predicted, kept.pairs.context, kept.pairs.agrees, strict=False)
    return plot_depth_scatter(list(pairs), affine.scale, affine.shift, unit)


def plot_losses(kept: TargetRecord) -> Iterator[tuple[Markup, str]]:
    """Plot the recorded losses of a target."""
    for name, caption in CURVE_CAPTIONS.items():
        curve = plot_loss(caption, kept.losses.get(name, ()))
        if curve is not None:
            yield curve, caption


def describe_coverage(summary: CompletionSummary) -> str:
    """Describe the coverage around the photographs."""
    covered = summary.coverage
    return (
        f"{covered.cameras} cameras around the photographs, none of them a target, test the "
        f"result: the scene covers {format_percent(covered.before)} of their images before and "
        f"{format_percent(covered.after)} after the completion."
    )


def embed_surrounding_views(
    found: FinishedCompletion, gallery: Gallery
) -> Iterator[tuple[Slider, str]]:
    """Embed the surrounding views that changed most."""
    for number, look in enumerate(found.record.around, start=1):
        slider = gallery.embed_slider(f"around{number}", f"Camera {number} around the photographs")
        yield slider, f"{format_percent(look.before, 0)} → {format_percent(look.after, 0)} covered"


def embed_ignored_images(
    summary: CompletionSummary, gallery: Gallery
) -> Iterator[tuple[Picture, str]]:
    """Embed the photographs that have ignored pixels."""
    for number, row in enumerate(summary.context, start=1):
        if row.ignored > 0:
            share = format_percent(row.ignored)
            caption = f"Photograph {row.frame}: {share} of the image is ignored (magenta)"
            yield gallery.embed_photo(f"context{number}_ignored.png", caption), caption


def draw_completion_cameras(found: FinishedCompletion) -> Markup | None:
    """Draw the cameras of the completion."""
    summary, record = found.summary, found.record
    frames = [row.frame for row in summary.context]
    cameras = label_cameras(
        list(zip(record.context, frames, strict=True)),
        [row.anchor for row in summary.targets if row.anchor is not None],
        [kept.camera for kept in record.targets],
        record.photographs,
    )
    return draw_cameras(list(cameras), record.points)


def describe_cameras(found: FinishedCompletion) -> str:
    """Describe how many cameras the drawing shows."""
    record = found.record
    kept, count = len(record.photographs), record.num_photographs
    text = f"{count} photographs" if kept == count else f"{kept} of {count} photographs"
    return f"{text}, {len(record.context)} in the context. Drag the drawing to rotate it."


def describe_total(summary: CompletionSummary) -> str:
    """Describe the total time and the device."""
    return f"{format_number(summary.seconds.get('total'), 1)} s in total on {summary.device}."


def make_score_tables(summary: CompletionSummary) -> list[Table]:
    """Make the tables of scores: targets, held-out photographs, context."""
    targets = [
        format_score_row(f"{n}: {row.name}", row) for n, row in enumerate(summary.targets, start=1)
    ]
    context = [format_score_row(f"photograph {row.frame}", row) for row in summary.context]
    unused = [format_score_row(f"photograph {row.frame}", row) for row in summary.held_out]
    if unused:
        unused.append(format_score_row("mean", average_score_rows(summary.held_out)))
    tables = [
        Table("At the targets", SCORE_COLUMNS, targets),
        Table("At held-out photographs", SCORE_COLUMNS, unused),
        Table("At the context photographs", SCORE_COLUMNS, context),
    ]
    return [table for table in tables if table.rows]


def average_score_rows(rows: Sequence[ScoreRow]) -> ScoreRow:
    """Average each score over the rows that have it."""
    names = ("psnr_before", "psnr_after", "ssim_before", "ssim_after")
    known = {name: [v for row in rows if (v := getattr(row, name)) is not None] for name in names}
    return ScoreRow(None, **{name: fmean(v) if v else None for name, v in known.items()})


def format_score_row(name: str, row: ScoreRow) -> list[str]:
    """Format a row of a table of scores."""
    psnr, ssim = (row.psnr_before, row.psnr_after), (row.ssim_before, row.ssim_after)
    return [
        name,
        *(format_number(value) for value in psnr),
        format_change(*psnr),
        *(format_number(value, 3) for value in ssim),
        format_change(*ssim, 3),
    ]


def get_stage_seconds(summary: CompletionSummary) -> dict[str, float]:
    """Return the seconds of each stage without the total."""
    return {name: seconds for name, seconds in summary.seconds.items() if name != "total"}


def make_settings_table(summary: CompletionSummary) -> Table:
    """Make the table of all settings."""
    facts = {
        "version": summary.version,
        "format": summary.scene.format,
        "near": summary.depth_range.near,
        "far": summary.depth_range.far,
        "seed": summary.seed,
        "device": summary.device,
    }
    rows = [*flatten_settings({"settings": summary.settings}), *flatten_settings({"found": facts})]
    return Table("All settings", ("setting", "value"), rows)


def flatten_settings(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Flatten nested settings to dotted names with values as JSON."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flatten_settings(value, f"{prefix}{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            yield f"{prefix}{name}", "–" if value is None else text
