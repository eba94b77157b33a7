"""Stage 4: refine added Gaussians, and nothing else (paper, Sec. III-F).

One file serves the paper and us: both minimize Eq. 13 in the same way. Ours fits colours first
(`color_rounds`, 0 in the paper) and stops when the loss has settled (`rel_tol`, None in the paper).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.config import RefineConfig
from gscompleter.numerics.adam import Adam
from gscompleter.numerics.geometry import measure_baseline
from gscompleter.render.fit_colors import RELAXATION, fit_colors
from gscompleter.render.protocols import OpacityRender
from gscompleter.stages.additions import Refined
from gscompleter.stages.target_view import TargetView
from gscompleter.system.progress import track
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.system.timing import timed_stage
from gscompleter.types import Gaussians, View


@timed_stage("integrate")
def refine(kept: Gaussians, reference: View, view: TargetView) -> Refined:
    """Refine colours against the image, then opacities also against the nearest photographs.

    Registration changes which Gaussians hide others, and so the image that Ψ fitted their colours
    to. The paper refines opacities alone (Eq. 13).
    """
    views = view.state.views
    config = view.state.config.refine

    # Colours against the image alone: the paper has no such step (decision 044).
    relaxations = [RELAXATION] * config.color_rounds
    colored = fit_colors(kept, [view.frozen], [reference], relaxations)

    # N_t of Eq. 13: the photographs taken closest to the target.
    distances = [measure_baseline(reference.camera, photo.camera) for photo in views]
    order = sorted(range(len(views)), key=distances.__getitem__)
    nearest = order[: config.num_views]

    # Only opacities change, so that everything else is projected and sorted once. The guard `psnr`
    # needs the plans of all photographs afterwards.
    plans = tuple(frozen.vary_opacities(colored) for frozen in view.frozen_photos)
    refined, losses = refine_opacities(
        colored,
        view.frozen.vary_opacities(colored),
        reference,
        [plans[i] for i in nearest],
        [views[i] for i in nearest],
        config,
    )
    return Refined(refined, plans, losses)


def keep_as_it_is(placed: Gaussians, reference: View, view: TargetView) -> Refined:
    """Refine nothing: what continues a surface has its colours and opacities from there."""
    plans = tuple(frozen.vary_opacities(placed) for frozen in view.frozen_photos)
    return Refined(placed, plans, ())


RefineAtTarget = Callable[[Gaussians, View, TargetView], Refined]
"""Refines what was placed, given the image at a target and the scene as that sees it."""


def has_settled(losses: Sequence[Float[Tensor, ""]], rel_tol: float) -> bool:
    """Return True if the relative decrease of the last step is at most `rel_tol`."""
    if len(losses) < 2:
        return False
    before, last = torch.stack([*losses[-2:]]).tolist()
    return before - last <= rel_tol * before


@use_one_torch_thread()
def refine_opacities(
    added: Gaussians,
    at_target: OpacityRender,
    reference: View,
    at_views: Sequence[OpacityRender],
    views: Sequence[View],
    config: RefineConfig = RefineConfig(),
) -> tuple[Gaussians, tuple[float, ...]]:
    """Minimize Eq. 13 over the opacities of added Gaussians; also return the loss per iteration.

    The context and all other parameters are fixed, so that nothing observed is forgotten.
    """
    if config.iterations == 0 or len(added) == 0:
        return added, ()

    # The terms of Eq. 13: λ for the synthesized image, 1 for each photograph.
    plans = [(at_target, reference, config.target_weight)]
    plans += [(plan, view, 1.0) for plan, view in zip(at_views, views, strict=True)]

    # In logits, as 3DGS stores opacities, no step leaves the range from 0 to 1.
    is_logit = config.parametrization == "logit"
    start = added.opacities.logit(eps=1e-4) if is_logit else added.opacities
    parameters = start.clone().requires_grad_()
    optimizer = Adam([(parameters, config.learning_rate)])

    def compute_opacities() -> Float[Tensor, "n"]:
        return parameters.sigmoid() if is_logit else parameters.clamp(0, 1)

    losses: list[Tensor] = []
    for _ in track(range(config.iterations), "Refining"):
        current = compute_opacities()
        terms = [
            weight * (view.fill_ignored(plan(current).image) - view.image).abs().mean()
            for plan, view, weight in plans
        ]
        loss = torch.stack(terms).sum()
        losses.append(loss.detach())
        if config.rel_tol is not None and has_settled(losses, config.rel_tol):
            break
        optimizer.step(loss)
    refined = replace(added, opacities=compute_opacities().detach(), encoded=None)
    return refined, tuple(torch.stack(losses).tolist())
