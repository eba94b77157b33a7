"""The output folder of a completion: scenes, images, report.json and summary.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter import __version__
from gscompleter.apps.inputs.task import InputSplatFile, Target
from gscompleter.apps.report.removal_pictures import draw_removal
from gscompleter.apps.report.schema import (
    RECORD_FILE,
    SCORES,
    AlignmentRow,
    CompletionRecord,
    ContextRow,
    PairsRow,
    TargetRow,
    UnfilledRow,
)
from gscompleter.config.settings import COVERED
from gscompleter.editing.removal import hide_removed
from gscompleter.evaluation.gap_pictures import draw_gap
from gscompleter.evaluation.metrics.coverage import RenderPair, compute_coverage
from gscompleter.evaluation.metrics.image import compute_masked_psnr, ssim
from gscompleter.evaluation.metrics.thin_gaps import (
    AT_TARGET,
    WorstGap,
    find_worst_gap,
    measure_flight,
    measure_thin_gaps,
    render_flight,
)
from gscompleter.evaluation.verdict.held_out import HeldOut, render_before_after, score_held_out
from gscompleter.evaluation.verdict.kept import measure_kept
from gscompleter.evaluation.verdict.outcome import judge_completion
from gscompleter.evaluation.verdict.rows import ScoreRow
from gscompleter.numerics.geometry import estimate_up
from gscompleter.numerics.image_ops import compute_mask_fraction, dilate, paint_marked
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.reconstructors.features.consistency import measure_pose_errors
from gscompleter.render.protocols import Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.splats.edits import AppendedRows, EditDraft, Edits, record_edit
from gscompleter.splats.layout import save_like, save_removed
from gscompleter.splats.ply import save_parts, save_ply
from gscompleter.splats.provenance import NOTHING_KNOWN, Provenance, RunRecord
from gscompleter.state import Completion
from gscompleter.system.files.image import write_image, write_pixels
from gscompleter.system.files.result_format import MARK
from gscompleter.system.files.writing import (
    COMPLETED_FILE,
    CONTEXT_FILE,
    REMOVED_FILE,
    SUMMARY_FILE,
)
from gscompleter.target_result import TargetResult
from gscompleter.types import Camera, Gaussians, View, merge

GENERATED_FILE = "generated.ply"
IMAGES = "images"
"""Folder of the pictures of a completion."""
MAX_PHOTOGRAPHS = 200
"""Largest number of photographs in the drawing and for the path of the video."""
MIN_POSED = 3
"""Fewest photographs whose poses are compared."""
FRUSTUM = ((-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1))
"""Image corners of a camera pyramid, whose apex is the origin."""
FRUSTUM_DEPTH = 0.11
"""Length of a camera pyramid, in radii."""

Scores = dict[str, Any]
"""PSNR and SSIM before and after by name, or None without a photograph."""


@dataclass(frozen=True)
class DrawingFrame:
    """Coordinate frame of a drawing."""

    center: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]
    """Unit axes as rows: right, up and back."""
    radius: float

    def convert(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Convert world points to the drawing."""
        return (points - self.center) @ self.axes.T / self.radius


@dataclass(frozen=True)
class TargetGaps:
    """Thin gaps after the completion of a target."""

    share: float
    """Share of the image at the target."""
    flight_share: float
    """The same on average on the way from the nearest photograph to the target."""
    worst: WorstGap | None
    """The worst place of both; None without thin gaps."""


def write_report(
    folder: Path,
    completion: Completion,
    targets: Sequence[Target],
    renderer: Renderer,
    run_info: Mapping[str, Any],
    input_splat: InputSplatFile | None = None,
    photographs: Sequence[Camera] = (),
    render_around: Callable[[], Sequence[RenderPair]] = list,
    held_out: Sequence[HeldOut] = (),
    files: Mapping[int | None, str] = MappingProxyType({}),
    has_searched: bool = True,
    run: RunRecord | None = None,
    testing: Sequence[Camera] = (),
    edit: EditDraft | None = None,
) -> dict[str, Any]:
    """Write the scenes, `images/`, `report.json` and `summary.json`; return the summary.

    `photographs` are the cameras of all, in the frame of the result. `render_around` renders the
    views whose coverage is measured. `files` are those of the photographs by frame. `has_searched`
    is False if targets were neither named nor searched for. `run` is what the files say about who
    made them. `testing` are cameras that decided nothing, at which what is kept is measured.
    `edit` is the command for `edits.json`.
    """
    at_targets = [
        render_before_after(completion, result.target, renderer) for result in completion.targets
    ]
    gaps = measure_gaps(completion, renderer)
    scores = make_score_rows(
        completion, targets, at_targets, gaps, renderer, held_out, files, has_searched
    )
    # Without targets, the photographs are what there is to look at.
    shown: list[View] = []
    if not completion.targets:
        photos = [photo.view for photo in completion.photos]
        shown = [*photos, *(photograph.view for photograph in held_out)]
    write_scenes(folder, completion, input_splat, run, edit or EditDraft("complete"))
    around = render_around()
    name_view = "ignored" if run_info.get("scene", {}).get("renders_from") is None else "render"
    write_pictures(folder / IMAGES, completion, targets, at_targets, name_view)
    for number, found in enumerate(gaps, start=1):
        write_pixels(folder / IMAGES / f"target{number}_gaps.png", draw_gap(found.worst))
    write_photographs(folder / IMAGES, completion, shown, renderer)
    removal = draw_removal(completion, renderer, files)
    if removal is not None:
        write_images(folder / IMAGES, "removal", removal.name_images())
    record = make_record(completion, thin_evenly(photographs, MAX_PHOTOGRAPHS))
    (folder / RECORD_FILE).write_bytes(json.dumps({**MARK, **asdict(record)}).encode() + b"\n")
    coverage = {"coverage": asdict(compute_coverage(around))} if around else {}
    left = {} if removal is None else {"removal": asdict(removal.row)}
    kept = measure_kept(completion, testing, renderer)
    left |= {} if kept is None else {"kept": asdict(kept)}
    notes = {"context_notes": completion.context_notes} if completion.context_notes else {}
    counts = {**count_changes(completion), **notes, **left, "seconds": dict(completion.seconds)}
    summary = {
        "version": __version__,
        "outcome": scores.pop("outcome"),
        **run_info,
        **coverage,
        **scores,
        **counts,
    }
    (folder / SUMMARY_FILE).write_bytes(json.dumps(summary, indent=2).encode() + b"\n")
    return summary


def make_score_rows(
    completion: Completion,
    targets: Sequence[Target],
    at_targets: Sequence[RenderPair],
    gaps: Sequence[TargetGaps],
    renderer: Renderer,
    held_out: Sequence[HeldOut] = (),
    files: Mapping[int | None, str] = MappingProxyType({}),
    has_searched: bool = True,
) -> dict[str, Any]:
    """Return the verdict and the rows of all photographs and targets, as in `summary.json`.

    `at_targets` are the renders at the targets, and `gaps` their thin gaps; the rest is as in
    `write_report`.
    """
    held_out_rows = score_held_out(completion, held_out, renderer)
    gains = completion.exposure_gains
    gain_rows = [None] * len(completion.views) if gains is None else gains.tolist()
    rows: dict[str, Sequence[ScoreRow]] = {
        "held_out": held_out_rows,
        "context": add_pose_errors(
            score_photographs(completion, completion.views, gain_rows, renderer), completion.views
        ),
        "targets": [
            replace(
                row,
                derived_file=files.get(row.derived_from),
                anchor_file=files.get(row.anchor),
            )
            for row in score_targets(completion, targets, at_targets, gaps, renderer)
        ],
    }
    if not completion.targets:
        checks = [photo.view for photo in completion.photos[completion.num_context :]]
        rows["checks"] = score_photographs(completion, checks, [None] * len(checks), renderer)
    scores = {
        key: [asdict(replace(row, file=files.get(row.frame))) for row in group]
        for key, group in rows.items()
    }
    # The verdict comes from the rows, so that the page and the terminal agree with them.
    outcome = judge_completion(completion, held_out_rows, has_searched, rows["context"])
    return {"outcome": asdict(outcome), **scores}


def compute_scores(pair: RenderPair, photograph: View | None) -> Scores:
    """Compute PSNR (dB) and SSIM over the valid pixels, or None without a photograph."""
    scores: Scores = dict.fromkeys(SCORES)
    if photograph is not None:
        truth = photograph.image
        valid = photograph.valid_mask
        for when, render in (("before", pair.before), ("after", pair.after)):
            scores[f"psnr_{when}"] = compute_masked_psnr(render.image, truth, valid)
            scores[f"ssim_{when}"] = ssim(photograph.fill_ignored(render.image), truth)
    return scores


def score_views(completion: Completion, views: Sequence[View], renderer: Renderer) -> list[Scores]:
    """Score the scene before and after at photographs, except where they show what was removed."""

    def score(view: View) -> Scores:
        shown = hide_removed(view, completion.source, renderer)
        return compute_scores(render_before_after(completion, view.camera, renderer), shown)

    map_views = get_view_map(completion.context.means, len(completion.context))
    return list(map_views(score, views))


def score_photographs(
    completion: Completion,
    views: Sequence[View],
    exposure_gains: Sequence[Any],
    renderer: Renderer,
) -> list[ContextRow]:
    """Make the rows of photographs of the context, or of those that checked a splat."""
    scores = score_views(completion, views, renderer)
    return [
        ContextRow(
            view.frame,
            **view_scores,
            exposure_gain=None if gain is None else tuple(gain),
            dynamic_fraction=compute_mask_fraction(view.dynamic_mask),
            given_depth=compute_mask_fraction(view.given_depth),
            ignored=compute_mask_fraction(view.ignore_mask),
        )
        for view, view_scores, gain in zip(views, scores, exposure_gains, strict=True)
    ]


def add_pose_errors(rows: Sequence[ContextRow], views: Sequence[View]) -> list[ContextRow]:
    """Add the pose errors to the rows of three photographs or more, which blur the scene by them.

    Two photographs agree with any pose but across their epipolar lines.
    """
    if len(views) < MIN_POSED:
        return list(rows)
    errors = measure_pose_errors(views)
    return [replace(row, pose_error=error) for row, error in zip(rows, errors, strict=True)]


def score_targets(
    completion: Completion,
    targets: Sequence[Target],
    pairs: Sequence[RenderPair],
    gaps: Sequence[TargetGaps],
    renderer: Renderer,
) -> list[TargetRow]:
    """Make the rows of the targets."""
    # Photographs of targets are read for their scores alone, and so stayed on the CPU.
    device = completion.context.means.device
    views = [
        t.view and hide_removed(t.view.to(device), completion.source, renderer) for t in targets
    ]
    scores = map_in_parallel(compute_scores, pairs, views)
    rows = zip(targets, completion.targets, scores, gaps, strict=True)
    return [make_target_row(completion, *row) for row in rows]


def measure_gaps(completion: Completion, renderer: Renderer) -> list[TargetGaps]:
    """Measure the thin gaps at each target, and on the way there from a photograph."""
    if not completion.targets:
        return []
    # As stages see it: of a large scene its proxy, which shows the same gaps.
    scene = merge(completion.parts)
    photographs = [view.camera for view in completion.views]
    gaps = []
    for result in completion.targets:
        flight = render_flight(scene, photographs, result.target, renderer)
        worst = find_worst_gap({AT_TARGET: result.after, **flight})
        share = measure_thin_gaps(result.after.alpha)
        gaps.append(TargetGaps(share, measure_flight(flight), worst))
    return gaps


def make_target_row(
    completion: Completion, target: Target, result: TargetResult, scores: Scores, gaps: TargetGaps
) -> TargetRow:
    """Make the row of a target."""
    fit = result.affine
    added = result.added
    empty = result.unfilled
    return TargetRow(
        target.frame,
        **scores,
        anchor=completion.views[result.anchor].frame,
        anchor_fallback=result.anchor_fallback,
        hole_fraction=result.hole_fraction,
        affine=AlignmentRow(fit.scale, fit.shift, fit.inliers, fit.method, fit.agreement),
        added=len(added),
        derived_from=target.derived_from,
        recolored=result.num_recolored,
        target_id=result.target_id if len(added) or result.num_recolored else None,
        unfilled=UnfilledRow(empty.share, empty.lost_by, empty.regions),
        notes=result.notes,
        warnings=result.warnings,
        refused=result.refusal,
        offset=target.offset,
        reason=target.reason or None,
        thin_gaps=gaps.share,
        flight_thin_gaps=gaps.flight_share,
        painter=result.painter or None,
    )


def count_changes(completion: Completion) -> dict[str, Any]:
    """Count the Gaussians and, of a splat, the photographs that it was not trained on."""
    counts = {"context": len(completion.context), "added": len(completion.added)}
    if completion.is_given:
        counts["from_photographs"] = completion.num_observed
    num_pieces = completion.count_added("piece")
    if num_pieces:
        counts["pieces"] = num_pieces
    num_removed = int(completion.source.gone_mask.sum())
    if num_removed:
        counts["removed"] = num_removed
    if completion.config.trust == "full":
        return {"gaussians": counts}
    counts["recolored"] = int(completion.recolored_mask.sum())
    return {"gaussians": counts, "new_photographs": completion.num_new_photos}


def thin_evenly(items: Sequence[Camera], most: int) -> Sequence[Camera]:
    """Take every n-th item so that at most `most` are left."""
    return items[:: max(1, -(-len(items) // most))]


def write_scenes(
    folder: Path,
    completion: Completion,
    input_splat: InputSplatFile | None,
    run: RunRecord | None,
    edit: EditDraft,
) -> None:
    """Write the three scenes, the originals of changed Gaussians, and `edits.json`.

    `run` is what the completed scene and the additions say about who made them.
    """
    made_by = NOTHING_KNOWN if run is None else Provenance((run,))
    # What is added lies in the frame of the context, and is written in that of its file.
    added = replace(completion.added, origin=completion.context.origin)
    changed = completion.recolored_mask | completion.source.gone_mask
    generated = merge([completion.recolored, added])
    if input_splat is None:
        order = torch.arange(len(completion.context))
        parts = [(part, torch.arange(len(part))) for part in (completion.kept_context, added)]
        completed = partial(
            save_parts, folder / COMPLETED_FILE, parts, provenance=True, made_by=made_by
        )
    else:
        # In the layout and the order of the user's file, so that what was kept is kept bit by bit.
        order = find_file_order(completion.context, input_splat)
        completed = partial(
            save_completed_splat, folder, completion.context, changed, generated, input_splat, run
        )
    # The context has labels if it was completed before.
    has_labels = bool((completion.context.generated > 0).any())
    if input_splat is None and completion.source.gone_mask.any():
        rows = completion.source.gone_mask.nonzero()[:, 0].cpu()
        save_removed(
            folder / REMOVED_FILE, completion.context[completion.source.gone_mask].to("cpu"), rows
        )
    writing = [
        completed,
        partial(save_parts, folder / CONTEXT_FILE, [(completion.context, order)], has_labels),
        partial(save_ply, folder / GENERATED_FILE, added, provenance=True, made_by=made_by),
    ]
    map_in_parallel(lambda write: write(), writing)
    record_edit(
        folder,
        replace(edit, seed=completion.seed),
        len(completion.context),
        list_appended(completion, input_splat is not None),
        None if input_splat is None else input_splat.path,
        Edits(folder) if input_splat is None else input_splat.edits,
        run,
        replace(completion.source.removed, origin=completion.context.origin),
        # Without the file of the given scene, recoloured rows stand where their originals were.
        can_be_undone=input_splat is not None or not completion.recolored_mask.any().item(),
    )


def list_appended(completion: Completion, appends_recolored: bool) -> list[AppendedRows]:
    """List the kinds of the rows of `completed.ply` after those of the context, in their order.

    `appends_recolored` is False if recoloured Gaussians stand in the rows of their originals.
    """
    num_recolored = len(completion.recolored) if appends_recolored else 0
    rows = [AppendedRows("recolored", num_recolored)]
    rows += [AppendedRows(part.origin.kind, len(part)) for part in completion.added_parts]
    return [row for row in rows if row.count]


def find_file_order(context: Gaussians, input_splat: InputSplatFile) -> Int64[Tensor, "n"]:
    """Find the Gaussians of the context in the order of the input file."""
    if input_splat.file_order is None:
        return torch.arange(len(context))
    # `file_order[i]` is the place in the file of Gaussian i; sorting by it inverts that.
    return input_splat.file_order.argsort()


def save_completed_splat(
    folder: Path,
    context: Gaussians,
    changed: Bool[Tensor, "n"],
    generated: Gaussians,
    input_splat: InputSplatFile,
    run: RunRecord | None = None,
) -> None:
    """Write `completed.ply` in the layout of the input splat, and the originals of the changed.

    `changed` marks the Gaussians of the context that were recoloured or removed. Recoloured ones
    stand among the generated ones, after all that kept its bits.
    """
    kept = input_splat.context_mask
    order = find_file_order(context, input_splat)
    if not changed.any():
        save_like(folder / COMPLETED_FILE, context, generated, input_splat.path, kept, order, run)
        return
    save_changed(folder, context, changed, input_splat)
    # The mask in the order of the file, over the Gaussians of the context and over all of the file.
    stays = ~changed.cpu()[order]
    order = order[stays]
    if kept is not None:
        stays = torch.zeros_like(kept).masked_scatter(kept, stays)
    save_like(folder / COMPLETED_FILE, context, generated, input_splat.path, stays, order, run)


def save_changed(
    folder: Path, context: Gaussians, changed: Bool[Tensor, "n"], input_splat: InputSplatFile
) -> None:
    """Write `removed.ply`, the originals of the changed Gaussians."""
    order = find_file_order(context, input_splat)
    rows = changed.cpu()[order].nonzero()[:, 0]
    removed = context[order[rows].to(context.means.device)].to("cpu")
    kept = input_splat.context_mask
    save_removed(folder / REMOVED_FILE, removed, rows, input_splat.path, kept)


def make_record(completion: Completion, photographs: Sequence[Camera]) -> CompletionRecord:
    """Draw all cameras, and list depth pairs."""
    context = [view.camera.to("cpu") for view in completion.views]
    targets = [result.target.to("cpu") for result in completion.targets]
    others = [camera.to("cpu") for camera in photographs]
    frame = fit_frame([*others, *context, *targets])

    def draw(cameras: Sequence[Camera]) -> tuple[str, ...]:
        return tuple(draw_camera(camera, frame) for camera in cameras)

    rows = []
    for result in completion.targets:
        pairs = result.affine.pairs
        columns = pairs.predicted, pairs.context, pairs.inlier_mask
        points = zip(*(column.tolist() for column in columns), strict=True)
        rows.append(PairsRow(pairs.fit_view, tuple(points)))
    return CompletionRecord(draw(others), draw(context), draw(targets), tuple(rows))


def fit_frame(cameras: Sequence[Camera]) -> DrawingFrame:
    """Fit a frame around cameras whose up axis is that of most of them."""
    up = estimate_up(cameras)
    # The most level camera gives the direction of the view; its axes are made level exactly.
    level = min(cameras, key=lambda camera: (camera.c2w[:3, 1] @ up).item())
    back = normalize(torch.linalg.cross(level.c2w[:3, 0], up), dim=0)
    centers = torch.stack([camera.center for camera in cameras])
    middle = centers.median(dim=0).values
    # At least a tiny radius: all cameras may stand in one place.
    radius = max(1.1 * (centers - middle).norm(dim=1).max().item(), 1e-9)
    return DrawingFrame(middle, torch.stack([torch.linalg.cross(up, back), up, back]), radius)


def draw_camera(camera: Camera, frame: DrawingFrame) -> str:
    """Write the corners of one line along the edges of a camera pyramid, centre first."""
    # Half the image over the focal length at z = 1, with the longer side always as long.
    size = torch.tensor([camera.width, camera.height]) / camera.K.diagonal()[:2]
    sides = torch.cat([0.6 * size / size.max(), torch.ones(1)])
    a, b, c, d = torch.tensor(FRUSTUM) * sides @ camera.c2w[:3, :3].T @ frame.axes.T
    # Edges from the apex to the corners and around, in a single line: some are drawn twice.
    o = torch.zeros(3)
    corners = FRUSTUM_DEPTH * torch.stack([o, a, b, c, d, a, b, o, c, d, o])
    points = frame.convert(camera.center) + corners
    return " ".join(f"{value:.3f}" for value in points.flatten().tolist())


def write_pictures(
    folder: Path,
    completion: Completion,
    targets: Sequence[Target],
    at_targets: Sequence[RenderPair],
    name_view: str = "ignored",
) -> None:
    """Write `images/`: targets, and photographs with ignored regions, or all renders of a splat."""
    folder.mkdir()
    results = zip(targets, completion.targets, at_targets, strict=True)
    for number, (target, result, pair) in enumerate(results, start=1):
        images = name_target_images(target, result, pair, completion.config.holes.dilation)
        write_images(folder, f"target{number}", images)
    for number, view in enumerate(completion.views, start=1):
        if view.ignore_mask is not None or name_view == "render":
            write_images(folder, f"context{number}", {name_view: paint_ignored(view)})


def write_photographs(
    folder: Path, completion: Completion, views: Sequence[View], renderer: Renderer
) -> None:
    """Write photographs and the scene before and after at their cameras, numbered from 1."""
    for number, view in enumerate(views, start=1):
        pair = render_before_after(completion, view.camera, renderer)
        images = {
            "before": pair.before.image,
            "after": pair.after.image,
            "truth": paint_ignored(view),
        }
        write_images(folder, f"photograph{number}", images)


def paint_ignored(view: View) -> Float[Tensor, "h w 3"]:
    """Paint the ignored pixels of a photograph in a colour that no scene has."""
    return paint_marked(view.image, ~view.valid_mask)


def paint_unfilled(result: TargetResult, pair: RenderPair) -> Float[Tensor, "h w 3"] | None:
    """Paint what stays empty of the hole of a target; None if the report has no word on it."""
    if not result.unfilled.describe():
        return None
    is_open = result.hole_mask & (pair.after.alpha < COVERED)
    return paint_marked(pair.after.image, is_open)


def paint_reference(result: TargetResult, dilation: int) -> Float[Tensor, "h w 3"] | None:
    """Paint what was synthesized for a target where it was used; None if nothing was.

    Elsewhere it is the scene before: there the image of Φ only guides the registration, and it may
    look worse than the scene.
    """
    if result.reference is None:
        return None
    is_used = dilate(result.hole_mask, dilation)[..., None]
    return result.reference.image.where(is_used, result.before.image)


def name_target_images(
    target: Target, result: TargetResult, pair: RenderPair, dilation: int
) -> dict[str, Tensor | None]:
    """Name the images of a target: colours [h, w, 3], grey or masks [h, w].

    `dilation` is that of the hole mask, in pixels.
    """
    alpha = result.trusted_alpha
    return {
        "before": pair.before.image,
        "after": pair.after.image,
        "hole_mask": result.hole_mask.float(),
        "unfilled": paint_unfilled(result, pair),
        "support": None if torch.equal(alpha, result.before.alpha) else alpha,
        "reference": paint_reference(result, dilation),
        "truth": None if target.view is None else paint_ignored(target.view),
    }


def write_images(folder: Path, name: str, images: Mapping[str, Tensor | None]) -> None:
    """Write the images that there are, in parallel, as `{name}_{ending}.png`."""
    known = {ending: image for ending, image in images.items() if image is not None}
    paths = [folder / f"{name}_{ending}.png" for ending in known]
    map_in_parallel(write_image, paths, known.values())


def join_images(
    pictures: Sequence[Float[Tensor, "h _w 3"]], gap: int = 4
) -> Float[Tensor, "h wide 3"]:
    """Join images of one height side by side on white."""
    white = torch.ones((pictures[0].shape[0], gap, 3))
    parts = [part for picture in pictures for part in (white, picture.cpu().clamp(0, 1))]
    return torch.cat(parts[1:], dim=1)
