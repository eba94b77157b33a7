"""All scores of one method on one case, against photographs and depths that were held back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.metrics.geometry import abs_rel, alignment
from gscompleter.metrics.image import masked_psnr, psnr, ssim
from gscompleter.metrics.lpips import try_lpips
from gscompleter.render import Renderer
from gscompleter.types import Camera, Gaussians, Render, View


@dataclass(frozen=True)
class Outcome:
    """What a method, ours or another, made of a scene."""

    context: Gaussians
    """The scene before."""
    scene: Gaussians
    """The scene after."""
    added: Gaussians | None
    """What stands in `scene` beside the context; None where the context itself was changed."""
    hole_mask: Bool[Tensor, "h w"]
    """True where the context has a hole, seen from the target; the same for all methods."""
    seconds: dict[str, float]
    """Wall time by stage, without that of the context, and `total`."""
    notes: tuple[str, ...] = ()
    """Fallbacks that were taken, a sentence each."""


@dataclass(frozen=True)
class Truth:
    """Photographs to score against. Their cameras have the depth range of the scene."""

    views: tuple[View, ...]
    """The context views."""
    target: View
    neighbours: tuple[View, ...] = ()


def ranged_truth(
    views: Sequence[View],
    target: View,
    neighbours: Sequence[View],
    near: float | None,
    far: float | None,
) -> Truth:
    """Photographs whose cameras have the depth range (scene units) that the method worked with."""

    def with_range(view: View) -> View:
        return replace(view, camera=replace(view.camera, near=near, far=far))

    return Truth(
        tuple(with_range(view) for view in views),
        with_range(target),
        tuple(with_range(view) for view in neighbours),
    )


@dataclass(frozen=True)
class Change:
    """One score before and after completion."""

    before: float
    after: float

    @property
    def gain(self) -> float:
        return self.after - self.before


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
    depth_rim: float | None
    """Median relative difference of depth between what was added, drawn alone, and the context,
    where both cover the target: the step at the border of the holes."""
    align_abs_rel: float | None
    """AbsRel of what was added against the context (`geometry_metrics.alignment`)."""
    align_chamfer: float | None
    """Chamfer distance between the two, as a share of the median depth at the target."""
    align_f_score: float | None
    """F-score between the two."""


@dataclass(frozen=True)
class Drawings:
    """What the target camera sees."""

    before: Render
    after: Render


@torch.no_grad()
def score(outcome: Outcome, truth: Truth, renderer: Renderer) -> tuple[Scores, Drawings]:
    """All scores of an outcome, and what the target camera sees of it."""
    target, hole = truth.target, outcome.hole_mask
    before = renderer.render(outcome.context, target.camera)
    after = renderer.render(outcome.scene, target.camera)
    covered = after.depth_map().valid
    context = [(_drawn(outcome, view, renderer), view.image) for view in truth.views]
    beside = [(_drawn(outcome, view, renderer), view.image) for view in truth.neighbours]
    added = outcome.added
    aligned, rim = None, None
    if added is not None and len(added) > 0:
        aligned = alignment(added, outcome.context, target.camera, renderer)
        rim = rim_error(added, before, target.camera, renderer)
    scores = Scores(
        hole_fraction=hole.float().mean().item(),
        target_before=quality(before.image, target.image),
        target_after=quality(after.image, target.image),
        hole_psnr=masked_psnr(after.image, target.image, hole),
        observed_psnr=_masked_change(before, after, target, ~hole),
        neighbours_psnr=mean_change(
            [Change(psnr(b, image), psnr(a, image)) for (b, a), image in beside]
        ),
        context_psnr=tuple(Change(psnr(b, image), psnr(a, image)) for (b, a), image in context),
        context_ssim=tuple(Change(ssim(b, image), ssim(a, image)) for (b, a), image in context),
        depth_observed=_abs_rel(after.depth, target.depth, ~hole & covered),
        depth_hole=_abs_rel(after.depth, target.depth, hole & covered),
        depth_rim=rim,
        align_abs_rel=None if aligned is None else aligned.abs_rel,
        align_chamfer=None if aligned is None else aligned.relative_chamfer,
        align_f_score=None if aligned is None else aligned.f_score,
    )
    return scores, Drawings(before, after)


def quality(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Quality:
    """PSNR, SSIM and, where the weights are at hand, LPIPS."""
    return Quality(
        psnr(image, truth),
        ssim(image, truth),
        try_lpips(image, truth, "vgg").value,
        try_lpips(image, truth, "alex").value,
    )


def rim_error(
    added: Gaussians,
    context: Render,
    target: Camera,
    renderer: Renderer,
    min_pixels: int = 50,
) -> float | None:
    """Median of |D_added - D_context| / D_context where both cover the target.

    None where fewer than `min_pixels` are covered by both.
    """
    alone = renderer.render(added, target)
    both = alone.depth_map().valid & context.depth_map().valid
    if both.sum() < min_pixels:
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
    outcome: Outcome, view: View, renderer: Renderer
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]:
    """The image of a view before and after."""
    return (
        renderer.render(outcome.context, view.camera).image,
        renderer.render(outcome.scene, view.camera).image,
    )


def _abs_rel(
    depth: Float[Tensor, "h w"], truth: Float[Tensor, "h w"] | None, where: Bool[Tensor, "h w"]
) -> float | None:
    """`abs_rel` over `where`; None where no truth is known."""
    return None if truth is None else abs_rel(depth, truth, where)
