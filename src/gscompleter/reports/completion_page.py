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

from gscompleter.data.formats import FORMATS
from gscompleter.kernels.sharing import side_by_side
from gscompleter.reports.camera_figure import PITCH, YAW, camera_figure, placed_cameras
from gscompleter.reports.figures import affine_scatter, colour_scale, loss_curve, time_bars
from gscompleter.reports.finished import Affine, Finished, Scores, Summary, TargetRow, read_finished
from gscompleter.reports.page import Gallery, Picture, Slider, Table, gallery_of, rendered
from gscompleter.reports.plain_words import about_scene, about_target, gain, percent, shown
from gscompleter.reports.record import TargetRecord

VIEWER = "view.html"
PICTURES = {
    "reference": "Reference: the synthesized image",
    "hole_mask": "Hole mask (white: hole)",
    "support": "Trust: agreement of the scene with the photographs (white: full)",
    "truth": "Photograph, used for scores only",
}
CURVES = {
    "register": "Loss of the registration along the rays",
    "refine": "Loss of the refinement",
}
METHODS = {
    "ransac": "RANSAC fits scene depth = {scale} × lifted depth {shift}; {inliers} of the pixels "
    "agree",
    "median": "The median depth ratio is used: scene depth = {scale} × lifted depth; "
    "{inliers} of the pixels agree",
    "identity": "The lifted depths are used unchanged",
}
SCORES = ("camera", "PSNR before", "PSNR after", "change", "SSIM before", "SSIM after", "change")


@dataclass(frozen=True)
class Section:
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


def completion_page(folder: Path) -> str:
    """Render the page of the completion in `folder`.

    Raises:
        InputError: if the folder has no completion, a damaged one, or one of another version.
    """
    found = read_finished(folder)
    summary, record = found.summary, found.record
    gallery, viewer = gallery_of(folder / "images"), viewer_of(folder)
    each = partial(section, gallery=gallery, unit=unit_of(summary), viewer=viewer)
    rows = list(enumerate(zip(summary.targets, record.targets, strict=True), start=1))
    return rendered(
        "completion.html",
        {
            "title": title_of(summary),
            "facts": facts_of(summary),
            "notes": about_scene(summary),
            "targets": side_by_side(lambda row: each(row[0], *row[1]), rows),
            "coverage": coverage_sentence(summary),
            "around": list(around(found, gallery)),
            "ignored": list(ignored_pictures(summary, gallery)),
            "cameras": cameras_of(found),
            "cameras_caption": cameras_caption(found),
            "yaw": YAW,
            "pitch": PITCH,
            "scores": score_tables(summary),
            "bars": time_bars("Seconds by stage", stages_of(summary)),
            "total": f"{shown(summary.seconds.get('total'), 1)} s in total on {summary.device}.",
            "settings": settings_table(summary),
            "viewer": viewer,
        },
    )


def viewer_of(folder: Path) -> str | None:
    """Return the address of the viewer's page if it exists."""
    return VIEWER if os.path.isfile(folder / VIEWER) else None


def title_of(summary: Summary) -> str:
    """Choose the title: the name of the scene folder or of the input splat."""
    path = summary.scene.splat or str(summary.settings.get("folder") or "")
    return Path(path).name or "Scene"


def unit_of(summary: Summary) -> str:
    """Return metres if the format defines them and the splat has no frame of its own."""
    format = FORMATS.get(summary.scene.format)
    known = format is not None and format.unit is not None and summary.frame.method == "given"
    return str(format.unit) if format is not None and known else "scene units"


def facts_of(summary: Summary) -> list[tuple[str, str]]:
    """List the numbers at the head of the page."""
    covered = summary.coverage
    facts = [
        ("covered around the photographs", f"{percent(covered.before)} → {percent(covered.after)}"),
        ("Gaussians added", f"{summary.gaussians.get('added', 0):,}"),
        ("targets", str(len(summary.targets))),
        ("time", f"{shown(summary.seconds.get('total'), 1)} s"),
    ]
    removed = summary.gaussians.get("removed")
    return facts if not removed else [*facts, ("Gaussians pruned", f"{removed:,}")]


def section(
    number: int, row: TargetRow, kept: TargetRecord, gallery: Gallery, unit: str, viewer: str | None
) -> Section:
    """Build the section of a target."""
    name = f"target{number}"
    limits = kept.depth_limits
    return Section(
        number=number,
        name=row.name,
        images=gallery.slider(name, f"Target {number}, {row.name}"),
        facts=target_facts(row),
        notes=about_target(row),
        link=None if viewer is None else f"{viewer}#camera=target-{number}",
        pictures=list(pictures_of(number, row, gallery)),
        depths=None
        if limits is None
        else gallery.slider(f"{name}_depth", f"Depth at target {number}", True),
        scale=None if limits is None else colour_scale(limits, unit),
        fit=fit_sentence(row.affine, unit),
        scatter=scatter_of(row.affine, kept, unit),
        seen_from="the anchor"
        if kept.pairs is None or kept.pairs.seen_from == "anchor"
        else "the target",
        curves=list(curves_of(kept)),
    )


def target_facts(row: TargetRow) -> list[tuple[str, str]]:
    """List the numbers below the images of a target."""
    facts = [("hole", percent(row.hole_fraction)), ("Gaussians added", f"{row.added:,}")]
    if row.anchor is not None:
        facts.append(("anchor", f"photograph {row.anchor}"))
    if row.psnr_after is not None:
        facts.append(("PSNR", f"{shown(row.psnr_before)} → {shown(row.psnr_after)} dB"))
        facts.append(("SSIM", f"{shown(row.ssim_before, 3)} → {shown(row.ssim_after, 3)}"))
    return facts


def pictures_of(number: int, row: TargetRow, gallery: Gallery) -> Iterator[tuple[Picture, str]]:
    """Embed the images of a target other than before and after."""
    for name, caption in PICTURES.items():
        file = f"target{number}_{name}.png"
        expected = name == "hole_mask" or (name == "truth" and row.psnr_after is not None)
        if expected or (gallery.folder / file).is_file():
            embed = gallery.exact if name in ("hole_mask", "support") else gallery.photo
            yield embed(file, f"{caption}, at target {number}"), caption


def fit_sentence(affine: Affine, unit: str) -> str:
    """Describe the depth alignment of a target."""
    sign = "−" if affine.shift < 0 else "+"
    shift = f"{sign} {shown(abs(affine.shift), 3)} {unit}"
    words = METHODS.get(affine.method, "The depths are aligned by an unknown method")
    text = words.format(
        scale=shown(affine.scale, 3), shift=shift, inliers=percent(affine.inliers, 0)
    )
    if affine.agreement is None:
        return f"{text}."
    return f"{text}. At the target, {percent(affine.agreement, 0)} of the visible scene agree."


def scatter_of(affine: Affine, kept: TargetRecord, unit: str) -> Markup | None:
    """Plot the depths that the alignment was fitted to, or return None without any."""
    if kept.pairs is None:
        return None
    pairs = zip(kept.pairs.predicted, kept.pairs.context, kept.pairs.agrees, strict=False)
    return affine_scatter(list(pairs), affine.scale, affine.shift, unit)


def curves_of(kept: TargetRecord) -> Iterator[tuple[Markup, str]]:
    """Plot the recorded losses of a target."""
    for name, caption in CURVES.items():
        curve = loss_curve(caption, kept.losses.get(name, ()))
        if curve is not None:
            yield curve, caption


def coverage_sentence(summary: Summary) -> str:
    """Describe the coverage around the photographs."""
    covered = summary.coverage
    return (
        f"{covered.cameras} cameras around the photographs, none of them a target, test the "
        f"result: the scene covers {percent(covered.before)} of their images before and "
        f"{percent(covered.after)} after the completion."
    )


def around(found: Finished, gallery: Gallery) -> Iterator[tuple[Slider, str]]:
    """Embed the surrounding views that changed most."""
    for number, look in enumerate(found.record.around, start=1):
        slider = gallery.slider(f"around{number}", f"Camera {number} around the photographs")
        yield slider, f"{percent(look.before, 0)} → {percent(look.after, 0)} covered"


def ignored_pictures(summary: Summary, gallery: Gallery) -> Iterator[tuple[Picture, str]]:
    """Embed the photographs that have ignored pixels."""
    for number, row in enumerate(summary.context, start=1):
        if row.ignored > 0:
            caption = (
                f"Photograph {row.frame}: {percent(row.ignored)} of the image is ignored (magenta)"
            )
            yield gallery.photo(f"context{number}_ignored.png", caption), caption


def cameras_of(found: Finished) -> Markup | None:
    """Draw the cameras of the completion."""
    summary, record = found.summary, found.record
    frames = [row.frame for row in summary.context]
    cameras = placed_cameras(
        list(zip(record.context, frames, strict=True)),
        [row.anchor for row in summary.targets if row.anchor is not None],
        [kept.camera for kept in record.targets],
        record.photographs,
    )
    return camera_figure(list(cameras), record.points)


def cameras_caption(found: Finished) -> str:
    """Describe how many cameras the drawing shows."""
    record = found.record
    kept, count = len(record.photographs), record.num_photographs
    text = f"{count} photographs" if kept == count else f"{kept} of {count} photographs"
    return f"{text}, {len(record.context)} in the context. Drag the drawing to rotate it."


def score_tables(summary: Summary) -> list[Table]:
    """Make the tables of scores: targets, held-out photographs, context."""
    targets = [score_row(f"{n}: {row.name}", row) for n, row in enumerate(summary.targets, start=1)]
    context = [score_row(f"photograph {row.frame}", row) for row in summary.context]
    unused = [score_row(f"photograph {row.frame}", row) for row in summary.held_out]
    if unused:
        unused.append(score_row("mean", mean_of(summary.held_out)))
    tables = [
        Table("At the targets", SCORES, targets),
        Table("At held-out photographs", SCORES, unused),
        Table("At the context photographs", SCORES, context),
    ]
    return [table for table in tables if table.rows]


def mean_of(rows: Sequence[Scores]) -> Scores:
    """Average each score over the rows that have it."""
    names = ("psnr_before", "psnr_after", "ssim_before", "ssim_after")
    known = {name: [v for row in rows if (v := getattr(row, name)) is not None] for name in names}
    return Scores(None, **{name: fmean(v) if v else None for name, v in known.items()})


def score_row(name: str, row: Scores) -> list[str]:
    """Format a row of a table of scores."""
    psnr, ssim = (row.psnr_before, row.psnr_after), (row.ssim_before, row.ssim_after)
    return [
        name,
        *(shown(value) for value in psnr),
        gain(*psnr),
        *(shown(value, 3) for value in ssim),
        gain(*ssim, 3),
    ]


def stages_of(summary: Summary) -> dict[str, float]:
    """Return the seconds of each stage without the total."""
    return {name: seconds for name, seconds in summary.seconds.items() if name != "total"}


def settings_table(summary: Summary) -> Table:
    """Make the table of all settings."""
    facts = {
        "version": summary.version,
        "format": summary.scene.format,
        "near": summary.depth_range.near,
        "far": summary.depth_range.far,
        "seed": summary.seed,
        "device": summary.device,
    }
    rows = [*flat({"settings": summary.settings}), *flat({"found": facts})]
    return Table("All settings", ("setting", "value"), rows)


def flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Flatten nested settings to dotted names with values as JSON."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            yield f"{prefix}{name}", "–" if value is None else text
