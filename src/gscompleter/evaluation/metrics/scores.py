"""Scores of one method on one case, against held-out photographs and depths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.evaluation.metrics.fitted_camera import FittedQuality, measure_fitted
from gscompleter.evaluation.metrics.geometry import (
    SurfaceAgreement,
    compare_depths,
    measure_alignment,
    measure_primitive_alignment,
)
from gscompleter.evaluation.metrics.image import (
    MAX_PSNR,
    compute_gradient_energy_ratio,
    compute_masked_psnr,
    ssim,
)
from gscompleter.evaluation.metrics.perceptual import (
    Image,
    compute_flip_map,
    compute_lpips,
    haarpsi,
)
from gscompleter.evaluation.metrics.st_lpips import compute_st_lpips
from gscompleter.evaluation.metrics.thin_gaps import (
    AT_TARGET,
    WorstGap,
    find_worst_gap,
    measure_flight,
    measure_thin_gaps,
    render_flight,
)
from gscompleter.render.protocols import Renderer
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.types import Camera, DepthMap, Gaussians, Render, View

MIN_DEPTH_PIXELS = 50
"""Minimum number of pixels for a median of depths."""


@dataclass(frozen=True)
class Truth:
    """Photographs to score against, in the depth range of the scene."""

    views: tuple[View, ...]
    """Photographs of the context."""
    target: View
    neighbours: tuple[View, ...] = ()
    """Photographs near the target that no method has seen."""


@dataclass(frozen=True)
class Change:
    """One score before and after completion."""

    before: float
    after: float


@dataclass(frozen=True)
class Quality:
    """Scores of one image against its photograph."""

    psnr: float
    """In dB."""
    ssim: float
    lpips_vgg: float | None
    """None if LPIPS is not available."""
    lpips_alex: float | None
    """As for `lpips_vgg`."""
    st_lpips: float | None
    """None if the package with its weights is missing, and for a tiny image."""


@dataclass(frozen=True)
class PartQuality:
    """Scores of a part of an image, most of which do not reward blur; None without a pixel."""

    psnr: float | None
    """In dB."""
    flip: float | None
    """Mean of the FLIP map; None also if flip-evaluator is missing."""
    haarpsi: float | None
    gradient_energy: float | None
    """Gradient energy over that of the photograph; None also if the photograph is flat."""


@dataclass(frozen=True)
class Scores:
    """Scores against held-out photographs, PSNR in dB; None if the truth is missing."""

    hole_fraction: float
    """Share of the target's pixels that the context does not cover."""
    target_before: Quality
    target_after: Quality
    hole: PartQuality
    """Quality after completion in the hole."""
    observed: PartQuality
    """Quality after completion over all other pixels."""
    fitted: FittedQuality | None
    """Quality after one pose and one gain of the target camera were fitted to its photograph; None
    if too little lies outside of holes."""
    neighbours_psnr: tuple[Change, ...]
    context_psnr: tuple[Change, ...]
    context_ssim: tuple[Change, ...]
    depth_observed: SurfaceAgreement | None
    """Completed z-depth against the true one where the context covers it."""
    depth_hole: SurfaceAgreement | None
    """The same in the hole, where it is filled."""
    seam_step: float | None
    """Median relative depth difference of the added Gaussians to the context, where both cover."""
    added: SurfaceAgreement | None
    """Added Gaussians against the context (`geometry.measure_alignment`)."""
    registered: SurfaceAgreement | None
    """All registered Gaussians against the context, before filtering."""
    thin_gaps: Change
    """Share of thin gaps at the target (`thin_gaps.measure_thin_gaps`)."""
    neighbours_thin_gaps: tuple[Change, ...]
    """The same at each neighbour."""
    flight_thin_gaps: Change | None
    """The same on the way from the nearest photograph to the target; None without photographs."""


@dataclass(frozen=True)
class TargetRenders:
    """Renders at the target, the holes before completion, and the worst thin gaps after it."""

    before: Render
    after: Render
    holes: Bool[Tensor, "h w"]
    worst_gap: WorstGap | None
    """At the target, its neighbours or on the way from a photograph; None without thin gaps."""


@torch.no_grad()
def score(
    before: Gaussians,
    after: Gaussians,
    added: Gaussians | None,
    truth: Truth,
    renderer: Renderer,
    registered: Gaussians | None = None,
) -> tuple[Scores, TargetRenders]:
    """Score a completion, and return what was rendered at and near the target.

    `before` and `after` are the scenes. `added` is None if existing Gaussians were changed;
    `registered` has all lifted Gaussians.
    """
    target = truth.target
    camera = target.camera
    was = renderer.render(before, camera)
    now = renderer.render(after, camera)
    holes = compute_hole_mask(was.alpha)
    covered = now.depth_map().valid & target.valid_mask

    def render_both(views: Sequence[View]) -> list[list[Render]]:
        return [
            [renderer.render(scene, view.camera) for scene in (before, after)] for view in views
        ]

    at_context = render_both(truth.views)
    at_neighbours = render_both(truth.neighbours)

    def compare_depths_in(region: Bool[Tensor, "h w"]) -> SurfaceAgreement | None:
        if target.depth is None:
            return None
        return compare_depths(now.depth, target.depth, region & covered)

    # Thin gaps open as the camera leaves the photographs: at the target, its neighbours and on the
    # way there.
    flight_gaps, flight = measure_flight_gaps(before, after, truth, renderer)
    completed = {AT_TARGET: now}
    for view, (_, render) in zip(truth.neighbours, at_neighbours, strict=True):
        completed[f"at neighbour {view.frame}"] = render
    completed |= flight

    # New Gaussians are compared with the scene before; a method may have added or lifted none.
    scores = Scores(
        hole_fraction=holes.float().mean().item(),
        target_before=measure_quality(was.image, target),
        target_after=measure_quality(now.image, target),
        hole=measure_part(now.image, target, holes),
        observed=measure_part(now.image, target, ~holes),
        fitted=measure_fitted(after, target, holes, renderer),
        neighbours_psnr=compare_views(at_neighbours, truth.neighbours, compute_view_psnr),
        context_psnr=compare_views(at_context, truth.views, compute_view_psnr),
        context_ssim=compare_views(at_context, truth.views, compute_view_ssim),
        depth_observed=compare_depths_in(~holes),
        depth_hole=compare_depths_in(holes),
        seam_step=measure_seam_step(added, was, camera, renderer) if added else None,
        added=measure_alignment(added, before, camera, renderer) if added else None,
        registered=(
            measure_primitive_alignment(registered, before, camera, renderer)
            if registered
            else None
        ),
        thin_gaps=Change(measure_thin_gaps(was.alpha), measure_thin_gaps(now.alpha)),
        neighbours_thin_gaps=tuple(
            Change(*(measure_thin_gaps(render.alpha) for render in pair)) for pair in at_neighbours
        ),
        flight_thin_gaps=flight_gaps,
    )
    return scores, TargetRenders(was, now, holes, find_worst_gap(completed))


def measure_flight_gaps(
    before: Gaussians, after: Gaussians, truth: Truth, renderer: Renderer
) -> tuple[Change | None, dict[str, Render]]:
    """Measure thin gaps on the way from the nearest photograph to the target.

    Also returns the renders after completion, by where they are; without photographs None and none.
    """
    if not truth.views:
        return None, {}
    photographs = [view.camera for view in truth.views]
    flight_before = render_flight(before, photographs, truth.target.camera, renderer)
    flight_after = render_flight(after, photographs, truth.target.camera, renderer)
    return Change(measure_flight(flight_before), measure_flight(flight_after)), flight_after


def measure_quality(image: Image, photograph: View) -> Quality:
    """Compute PSNR, SSIM and, if the weights are available, LPIPS and ST-LPIPS.

    Ignored pixels of the photograph do not count for PSNR and count as equal for the others.
    """
    truth = photograph.image
    compared = photograph.fill_ignored(image)
    return Quality(
        compute_view_psnr(image, photograph),
        compute_view_ssim(image, photograph),
        compute_lpips(compared, truth, "vgg"),
        compute_lpips(compared, truth, "alex"),
        compute_st_lpips(compared, truth),
    )


def compute_view_psnr(image: Image, photograph: View) -> float:
    """Compute PSNR in dB over valid pixels of the photograph; `MAX_PSNR` if there are none."""
    counted = compute_masked_psnr(image, photograph.image, photograph.valid_mask)
    return MAX_PSNR if counted is None else counted


def compute_view_ssim(image: Image, photograph: View) -> float:
    """Compute SSIM, with ignored pixels of the photograph counted as equal."""
    return ssim(photograph.fill_ignored(image), photograph.image)


def measure_part(image: Image, photograph: View, where: Bool[Tensor, "h w"]) -> PartQuality:
    """Score an image over the valid pixels of its photograph in `where`."""
    compared = photograph.fill_ignored(image)
    truth = photograph.image
    where = where & photograph.valid_mask
    # The map is computed once, with the surroundings of each pixel, and then averaged in the part.
    errors = compute_flip_map(compared, truth)
    return PartQuality(
        compute_masked_psnr(image, truth, where),
        None if errors is None or not where.any() else errors[where.cpu()].mean().item(),
        haarpsi(compared, truth, where),
        compute_gradient_energy_ratio(compared, truth, where),
    )


def measure_seam_step(
    added: Gaussians, context: Render, target: Camera, renderer: Renderer
) -> float | None:
    """Compute the median of |D_added - D_context| / D_context; None for too few pixels."""
    alone = renderer.render(added, target).depth_map()
    steps = (alone.depth - context.depth).abs() / context.depth
    return compute_median(steps, alone.valid & context.depth_map().valid)


def compute_depth_scale(
    added: Gaussians,
    holes: Bool[Tensor, "h w"],
    target: Camera,
    expected: DepthMap,
    renderer: Renderer,
) -> float | None:
    """Compute the median of D_added / D_expected over the holes: 1 means metric scale.

    D_added is the z-depth of `added` rendered alone. Only holes count, so that methods covering the
    whole image are comparable. None for too few pixels.
    """
    alone = renderer.render(added, target).depth_map()
    return compute_median(alone.depth / expected.depth, holes & alone.valid & expected.valid)


def compute_median(values: Float[Tensor, "h w"], where: Bool[Tensor, "h w"]) -> float | None:
    """Compute the median over the pixels of `where`; None for fewer than `MIN_DEPTH_PIXELS`."""
    return None if where.sum() < MIN_DEPTH_PIXELS else values[where].median().item()


def compare_views(
    pairs: Sequence[Sequence[Render]],
    views: Sequence[View],
    metric: Callable[[Image, View], float],
) -> tuple[Change, ...]:
    """Compute a metric for each view, whose renders before and after are `pairs`."""
    both = zip(pairs, views, strict=True)
    return tuple(
        Change(metric(was.image, view), metric(now.image, view)) for (was, now), view in both
    )
