"""Rows of `summary.json`: scores of photographs and targets, thin gaps, and counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any

import torch

from gscompleter.apps.inputs.task import Target
from gscompleter.apps.report.schema import (
    SCORES,
    AlignmentRow,
    ContextRow,
    FittedRow,
    GeometryRow,
    TargetRow,
    UnfilledRow,
)
from gscompleter.editing.removal import hide_removed
from gscompleter.evaluation.metrics.coverage import RenderPair
from gscompleter.evaluation.metrics.fitted_camera import fit_gains, measure_fitted
from gscompleter.evaluation.metrics.image import compute_masked_psnr, ssim
from gscompleter.evaluation.metrics.thin_gaps import (
    AT_TARGET,
    WorstGap,
    find_worst_gap,
    measure_flight,
    measure_thin_gaps,
    render_flight,
)
from gscompleter.evaluation.verdict.held_out import (
    Drawing,
    HeldOut,
    make_drawing,
    score_held_out,
)
from gscompleter.evaluation.verdict.outcome import judge_completion
from gscompleter.evaluation.verdict.rows import ScoreRow
from gscompleter.numerics.image_ops import compute_mask_fraction
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.reconstructors.features.consistency import measure_pose_errors
from gscompleter.render.protocols import Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.state import Completion
from gscompleter.target_result import GeometryUse, TargetResult
from gscompleter.types import View, merge

MIN_POSED = 3
"""Fewest photographs whose poses are compared."""

ScoreValues = dict[str, Any]
"""PSNR and SSIM before and after by name, or None without a photograph."""


@dataclass(frozen=True)
class TargetGaps:
    """Thin gaps after the completion of a target."""

    share: float
    """Share of the image at the target."""
    flight_share: float
    """The same on average on the way from the nearest photograph to the target."""
    worst: WorstGap | None
    """The worst place of both; None without thin gaps."""


def make_score_rows(
    completion: Completion,
    targets: Sequence[Target],
    at_targets: Sequence[RenderPair],
    gaps: Sequence[TargetGaps],
    renderer: Renderer,
    held_out: Sequence[HeldOut] = (),
    files: Mapping[int | None, str] = MappingProxyType({}),
    has_searched: bool = True,
    draw: Drawing | None = None,
) -> dict[str, Any]:
    """Return the verdict and the rows of all photographs and targets, as in `summary.json`.

    `at_targets` are the renders at the targets, and `gaps` their thin gaps; `draw` renders each
    photograph once, by default as `make_drawing`. The rest is as in `write_report`.
    """
    draw = draw or make_drawing(completion, renderer)
    held_out_rows = score_held_out(completion, held_out, renderer, draw)
    gains = completion.exposure_gains
    gain_rows = [None] * len(completion.views) if gains is None else gains.tolist()
    rows: dict[str, Sequence[ScoreRow]] = {
        "held_out": held_out_rows,
        "context": add_pose_errors(
            score_photographs(completion, completion.views, gain_rows, renderer, draw),
            completion.views,
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
    # Where no target was completed, the photographs that check the splat tell what changed.
    if not completion.targets:
        checks = [photo.view for photo in completion.photos[completion.num_context :]]
        rows["checks"] = score_photographs(completion, checks, [None] * len(checks), renderer, draw)
    scores = {
        key: [asdict(replace(row, file=files.get(row.frame))) for row in group]
        for key, group in rows.items()
    }
    # The verdict comes from the rows, so that the page and the terminal agree with them.
    outcome = judge_completion(completion, held_out_rows, has_searched, rows["context"])
    return {"outcome": asdict(outcome), **scores}


def compute_scores(pair: RenderPair, photograph: View | None) -> ScoreValues:
    """Compute PSNR (dB) and SSIM over the valid pixels, or None without a photograph."""
    scores: ScoreValues = dict.fromkeys(SCORES)
    if photograph is not None:
        truth = photograph.image
        valid = photograph.valid_mask
        for when, render in (("before", pair.before), ("after", pair.after)):
            scores[f"psnr_{when}"] = compute_masked_psnr(render.image, truth, valid)
            scores[f"ssim_{when}"] = ssim(photograph.fill_ignored(render.image), truth)
    return scores


def score_views(
    completion: Completion, views: Sequence[View], renderer: Renderer, draw: Drawing
) -> list[ScoreValues]:
    """Score the scene before and after at photographs, except where they show what was removed."""

    def score(view: View) -> ScoreValues:
        shown = hide_removed(view, completion.source, renderer)
        pair = draw(view)
        if completion.is_remade and shown is not None:
            # The photographs have the exposure of the new scene, not that of the given one.
            before = pair.before.image
            arrays = (tensor.cpu().numpy() for tensor in (before, shown.image, shown.valid_mask))
            gains = torch.from_numpy(fit_gains(*arrays)).to(before)
            pair = replace(pair, before=replace(pair.before, image=before * gains))
        return compute_scores(pair, shown)

    map_views = get_view_map(completion.context.means, len(completion.context))
    return list(map_views(score, views))


def score_photographs(
    completion: Completion,
    views: Sequence[View],
    exposure_gains: Sequence[Any],
    renderer: Renderer,
    draw: Drawing,
) -> list[ContextRow]:
    """Make the rows of photographs of the context, or of those that checked a splat.

    `exposure_gains` are three factors (R, G, B) for each photograph, or None for it.
    """
    scores = score_views(completion, views, renderer, draw)
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
    fitted = fit_targets(completion, views, pairs, renderer)
    rows = zip(targets, completion.targets, scores, gaps, fitted, strict=True)
    return [make_target_row(completion, *row) for row in rows]


def fit_targets(
    completion: Completion,
    photographs: Sequence[View | None],
    pairs: Sequence[RenderPair],
    renderer: Renderer,
) -> list[FittedRow | None]:
    """Score the scene at targets after a pose and a gain of each were fitted to its photograph."""
    if not any(photographs):
        return [None] * len(pairs)
    # As stages see it: of a large scene its proxy.
    scene = merge(completion.parts)
    rows: list[FittedRow | None] = []
    for photograph, pair in zip(photographs, pairs, strict=True):
        fitted = None
        if photograph is not None:
            holes = compute_hole_mask(pair.before.alpha)
            fitted = measure_fitted(scene, photograph, holes, renderer)
        rows.append(None if fitted is None else FittedRow(**asdict(fitted)))
    return rows


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
    completion: Completion,
    target: Target,
    result: TargetResult,
    scores: ScoreValues,
    gaps: TargetGaps,
    fitted: FittedRow | None,
) -> TargetRow:
    """Make the row of a target."""
    fit = result.affine
    empty = result.unfilled
    return TargetRow(
        target.frame,
        **scores,
        anchor=completion.views[result.anchor].frame,
        anchor_fallback=result.anchor_fallback,
        hole_fraction=result.hole_fraction,
        affine=AlignmentRow(fit.scale, fit.shift, fit.inliers, fit.method, fit.agreement),
        added=len(result.added),
        derived_from=target.derived_from,
        recolored=result.num_recolored,
        target_id=result.target_id if result.has_changed_scene else None,
        unfilled=UnfilledRow(empty.share, empty.lost_by, empty.regions),
        notes=result.notes,
        warnings=result.warnings,
        refused=result.refusal,
        offset=target.offset,
        reason=target.reason or None,
        thin_gaps=gaps.share,
        flight_thin_gaps=gaps.flight_share,
        painter=result.painter or None,
        geometry=make_geometry_row(result.geometry),
        fitted=fitted,
    )


def make_geometry_row(use: GeometryUse) -> GeometryRow | None:
    """Make the row of the use of geometry; None if none is given."""
    if not use.name:
        return None
    return GeometryRow(use.share, use.contradicted, use.added)


def count_changes(completion: Completion) -> dict[str, Any]:
    """Count the Gaussians and, of a splat, the photographs that it was not trained on."""
    counts = {"context": len(completion.context), "added": len(completion.added)}
    if completion.is_given:
        counts["from_photographs"] = completion.num_observed
    if completion.geometry is not None:
        counts["on_geometry"] = sum(result.geometry.added for result in completion.targets)
    num_pieces = completion.count_added("piece")
    if num_pieces:
        counts["pieces"] = num_pieces
    num_removed = int(completion.source.removed_mask.sum())
    if num_removed:
        counts["removed"] = num_removed
    num_replaced = int(completion.source.replaced_mask.sum())
    if num_replaced:
        counts["replaced"] = num_replaced
    # Under full trust no photograph is compared with the splat, so that none is new to it.
    if completion.config.trust == "full":
        return {"gaussians": counts}
    counts["recolored"] = int(completion.recolored_mask.sum())
    return {"gaussians": counts, "new_photographs": completion.num_new_photos}
