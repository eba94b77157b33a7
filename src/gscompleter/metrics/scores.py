"""All scores of one method on one case, against photographs and depths that were held back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.metrics.flip import flip_map
from gscompleter.metrics.geometry import (
    Alignment,
    abs_rel,
    alignment,
    num_known,
    primitive_alignment,
)
from gscompleter.metrics.haarpsi import haarpsi
from gscompleter.metrics.image import MAX_PSNR, gradient_energy_ratio, masked_psnr, ssim
from gscompleter.metrics.lpips import lpips_if_available
from gscompleter.render import Renderer
from gscompleter.stages.integration import hole_mask
from gscompleter.types import Camera, Gaussians, Render, View

Image = Float[Tensor, "h w 3"]

MIN_PIXELS = 50
"""Fewest pixels that a difference or a ratio of depths is a median of."""


@dataclass(frozen=True)
class Truth:
    """Photographs to score against. Their cameras have the depth range of the scene."""

    views: tuple[View, ...]
    """The context views."""
    target: View
    neighbours: tuple[View, ...] = ()


@dataclass(frozen=True)
class Change:
    """One score before and after completion."""

    before: float
    after: float


@dataclass(frozen=True)
class Quality:
    """One image against its photograph."""

    psnr: float
    """In dB."""
    ssim: float
    lpips_vgg: float | None
    """None where the weights are not on this machine."""
    lpips_alex: float | None


@dataclass(frozen=True)
class Looks:
    """Part of an image against its photograph, by what does not reward blur. None: of no pixel."""

    flip: float | None
    """Mean of the map of FLIP; None where flip-evaluator is missing, too."""
    haarpsi: float | None
    gradient_energy: float | None
    """As a multiple of the photograph's; None where that is flat, too."""


@dataclass(frozen=True)
class Scores:
    """How a completion fares against the photographs it did not see. None: no truth exists."""

    hole_fraction: float
    """Share of the target's pixels that the context does not cover."""
    target_before: Quality
    target_after: Quality
    hole_psnr: float | None
    """PSNR at the target over the pixels of the hole only, after completion."""
    observed_psnr: Change | None
    """PSNR at the target over all other pixels."""
    neighbours_psnr: Change | None
    """Mean over the neighbours."""
    context_psnr: tuple[Change, ...]
    """Of each context view."""
    context_ssim: tuple[Change, ...]
    """Of each context view."""
    depth_observed: float | None
    """AbsRel at the target against the true depth, where the context covers it."""
    depth_hole: float | None
    """The same where the context has a hole and the completion fills it."""
    depth_observed_pixels: int | None = None
    """Number of pixels that `depth_observed` is the mean of."""
    depth_hole_pixels: int | None = None
    """Number of pixels that `depth_hole` is the mean of."""
    depth_rim: float | None = None
    """Median relative difference of depth between what was added, drawn alone, and the context,
    where both cover the target: the step at the border of the holes."""
    align_pixels: int | None = None
    """Number of pixels of the target that both cover: of `depth_rim` and the three below."""
    align_abs_rel: float | None = None
    """AbsRel of what was added against the context (`geometry.alignment`)."""
    align_chamfer: float | None = None
    """Chamfer distance between the two, as a share of the median depth at the target."""
    align_f_score: float | None = None
    """F-score between the two."""
    registered_pixels: int | None = None
    """Number of pixels of the target that the context covers and lifted Gaussians fall on, as they
    were registered and before any were filtered: of the three below."""
    registered_abs_rel: float | None = None
    """AbsRel of all that was lifted against the context (`geometry.primitive_alignment`)."""
    registered_chamfer: float | None = None
    """Chamfer distance between the two, as a share of the median depth at the target."""
    registered_f_score: float | None = None
    """F-score between the two."""
    hole_looks: Looks | None = None
    """At the target, in the hole, after completion."""
    observed_looks: Looks | None = None
    """Of all other pixels."""


@dataclass(frozen=True)
class Drawings:
    """What the target camera sees."""

    before: Render
    after: Render
    holes: Bool[Tensor, "h w"]
    """True where the scene before has a hole."""


@torch.no_grad()
def score(
    before: Gaussians,
    after: Gaussians,
    added: Gaussians | None,
    truth: Truth,
    renderer: Renderer,
    registered: Gaussians | None = None,
) -> tuple[Scores, Drawings]:
    """All scores of a completion, and what the target camera sees of it.

    Args:
        before: The scene before.
        after: The scene after.
        added: What stands in `after` beside `before`; None where that itself was changed.
        truth: The photographs.
        renderer: Draws all of them.
        registered: All that was lifted, as it was registered; None where nothing was.
    """
    target = truth.target
    was = renderer.render(before, target.camera)
    now = renderer.render(after, target.camera)
    counted = target.counted
    holes, covered = hole_mask(was.alpha), now.depth_map().valid & counted
    context = _drawn(before, after, truth.views, renderer)
    beside = _drawn(before, after, truth.neighbours, renderer)
    scores = Scores(
        hole_fraction=holes.float().mean().item(),
        target_before=quality(was.image, target),
        target_after=quality(now.image, target),
        hole_psnr=masked_psnr(now.image, target.image, holes & counted),
        observed_psnr=_masked_change(was, now, target, ~holes & counted),
        neighbours_psnr=mean_change(_changes(beside, counted_psnr)),
        context_psnr=_changes(context, counted_psnr),
        context_ssim=_changes(context, counted_ssim),
        depth_observed=abs_rel(now.depth, target.depth, ~holes & covered),
        depth_hole=abs_rel(now.depth, target.depth, holes & covered),
        depth_observed_pixels=num_known(target.depth, ~holes & covered),
        depth_hole_pixels=num_known(target.depth, holes & covered),
        hole_looks=looks(target.compared(now.image), target.image, holes & counted),
        observed_looks=looks(target.compared(now.image), target.image, ~holes & counted),
    )
    if added is not None and len(added) > 0:
        aligned = alignment(added, before, target.camera, renderer)
        scores = replace(
            scores,
            depth_rim=rim_error(added, was, target.camera, renderer),
            **alignment_scores("align", aligned),
        )
    if registered is not None and len(registered) > 0:
        aligned = primitive_alignment(registered, before, target.camera, renderer)
        scores = replace(scores, **alignment_scores("registered", aligned))
    return scores, Drawings(was, now, holes)


def alignment_scores(name: str, aligned: Alignment) -> dict[str, Any]:
    """Name the fields of `Scores` that an alignment fills, each after `name`."""
    return {
        f"{name}_pixels": aligned.pixels,
        f"{name}_abs_rel": aligned.abs_rel,
        f"{name}_chamfer": aligned.relative_chamfer,
        f"{name}_f_score": aligned.f_score,
    }


def quality(image: Float[Tensor, "h w 3"], photograph: View) -> Quality:
    """PSNR, SSIM and, where the weights are at hand, LPIPS.

    What is to be ignored of the photograph does not count for PSNR, and counts as equal for the
    others, which look at neighbourhoods.
    """
    truth, compared = photograph.image, photograph.compared(image)
    return Quality(
        counted_psnr(image, photograph),
        counted_ssim(image, photograph),
        lpips_if_available(compared, truth, "vgg"),
        lpips_if_available(compared, truth, "alex"),
    )


def counted_psnr(image: Float[Tensor, "h w 3"], photograph: View) -> float:
    """PSNR in dB over the pixels of the photograph that count; of none it is that of equality."""
    counted = masked_psnr(image, photograph.image, photograph.counted)
    return MAX_PSNR if counted is None else counted


def counted_ssim(image: Float[Tensor, "h w 3"], photograph: View) -> float:
    """SSIM, with what is to be ignored of the photograph taken for equal."""
    return ssim(photograph.compared(image), photograph.image)


def looks(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> Looks:
    """FLIP, HaarPSI and the ratio of gradient energies over the pixels of `where`."""
    errors = flip_map(image, truth)
    return Looks(
        None if errors is None or not where.any() else errors[where.cpu()].mean().item(),
        haarpsi(image, truth, where),
        gradient_energy_ratio(image, truth, where),
    )


def rim_error(
    added: Gaussians, context: Render, target: Camera, renderer: Renderer
) -> float | None:
    """Median of |D_added - D_context| / D_context where both cover the target.

    None where fewer than `MIN_PIXELS` are covered by both.
    """
    alone = renderer.render(added, target).depth_map()
    both = alone.valid & context.depth_map().valid
    if both.sum() < MIN_PIXELS:
        return None
    return ((alone.depth - context.depth).abs() / context.depth)[both].median().item()


def mean_change(changes: Sequence[Change]) -> Change | None:
    """Mean before and mean after; None of nothing."""
    if not changes:
        return None
    n = len(changes)
    return Change(sum(c.before for c in changes) / n, sum(c.after for c in changes) / n)


def _masked_change(
    before: Render, after: Render, target: View, where: Bool[Tensor, "h w"]
) -> Change | None:
    was = masked_psnr(before.image, target.image, where)
    now = masked_psnr(after.image, target.image, where)
    return None if was is None or now is None else Change(was, now)


def _drawn(
    before: Gaussians, after: Gaussians, views: Sequence[View], renderer: Renderer
) -> list[tuple[Image, Image, View]]:
    """The image of each view before and after, and its photograph."""
    return [
        (
            renderer.render(before, view.camera).image,
            renderer.render(after, view.camera).image,
            view,
        )
        for view in views
    ]


def _changes(
    drawn: Sequence[tuple[Image, Image, View]], metric: Callable[[Image, View], float]
) -> tuple[Change, ...]:
    return tuple(Change(metric(was, view), metric(now, view)) for was, now, view in drawn)
