"""Stage 4: keep what lies in the holes and refine its opacities, and nothing else
(paper, Sec. III-F)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.config import HarmConfig, HoleConfig, RefineConfig
from gscompleter.descent import Adam
from gscompleter.geometry import inside, project
from gscompleter.progress import track
from gscompleter.render import FrozenView, OpacityRender
from gscompleter.types import Camera, Gaussians, View

MAX_TRIALS = 24
"""How often harmful Gaussians lose half of their opacity before a view that still does not hold
loses all it sees of them."""


def hole_mask(
    alpha: Float[Tensor, "h w"], config: HoleConfig = HoleConfig()
) -> Bool[Tensor, "h w"]:
    """Where the scene covers too little, before dilation (paper, Eq. 12)."""
    return alpha < config.max_alpha


def keep_in_holes(
    registered: Gaussians,
    pixel_index: Int[Tensor, "n"] | None,
    mask: Bool[Tensor, "h w"],
    target: Camera,
) -> Gaussians:
    """The Gaussians that fall within `mask`: by their pixel where it is known, else projected."""
    if pixel_index is not None:
        return registered[mask.flatten()[pixel_index]]
    pixels, z = project(registered.means, target)
    seen = inside(pixels, z, target)
    x, y = pixels.where(seen[:, None], 0.0).long().unbind(-1)
    return registered[seen & mask[y, x]]


def refine_opacities(
    added: Gaussians,
    frozen_target: FrozenView,
    reference: View,
    frozen_views: Sequence[FrozenView],
    views: Sequence[View],
    config: RefineConfig = RefineConfig(),
) -> tuple[Gaussians, tuple[float, ...]]:
    """`added` with opacities that minimise Eq. 13, and the loss of each iteration.

    Everything else of them, and all of the scene, stays as it is: what was good cannot be
    forgotten.
    """
    if config.iterations == 0 or len(added) == 0:
        return added, ()
    plans = [(frozen_target.plan(added), reference.image, config.target_weight)]
    seen = zip(frozen_views, views, strict=True)
    plans += [(frozen.plan(added), view.image, 1.0) for frozen, view in seen]

    logit = config.parametrization == "logit"
    start = added.opacities.logit(eps=1e-4) if logit else added.opacities
    parameters = start.clone().requires_grad_()
    optimizer = Adam([(parameters, config.learning_rate)])

    def opacities() -> Float[Tensor, "n"]:
        return parameters.sigmoid() if logit else parameters.clamp(0, 1)

    losses = []
    for _ in track(range(config.iterations), "Refining"):
        current = opacities()
        terms = [w * (plan(current).image - image).abs().mean() for plan, image, w in plans]
        loss = torch.stack(terms).sum()
        optimizer.step(loss)
        losses.append(loss.item())
    return replace(added, opacities=opacities().detach(), encoded=None), tuple(losses)


def do_no_harm(
    added: Gaussians,
    frozen_views: Sequence[FrozenView],
    views: Sequence[View],
    allowed_errors: Sequence[float],
    config: HarmConfig = HarmConfig(),
) -> Gaussians:
    """`added` with opacities lowered until no photograph is matched worse than allowed.

    In a view that got worse, a Gaussian is harmful where less opacity would bring the view nearer
    to its photograph. The most harmful ones are halved, no more of them than it takes; a view
    that still does not hold after `MAX_TRIALS` loses every generated Gaussian that it sees, which
    restores it.

    Args:
        added: Generated Gaussians.
        frozen_views: The scene frozen at the camera of each of `views`.
        views: The photographs.
        allowed_errors: Largest mean squared error allowed in each view.
        config: How it is checked.
    """
    if config.tolerance is None or len(added) == 0:
        return added
    checks = [
        (frozen.plan(added), view.image, allowed)
        for frozen, view, allowed in zip(frozen_views, views, allowed_errors, strict=True)
    ]
    opacities = added.opacities
    for trial in range(MAX_TRIALS + 1):
        lowered = torch.zeros_like(opacities, dtype=torch.bool)
        for plan, photograph, allowed in checks:
            error = squared_error(plan(opacities).image, photograph).item()
            if error <= allowed:
                continue
            _, slope = error_slope(plan, photograph, opacities)
            if trial == MAX_TRIALS:
                lowered |= slope != 0
            else:
                lowered |= most_harmful(slope * opacities / 2, error - allowed)
        if not lowered.any():
            break
        factor = 0.5 if trial < MAX_TRIALS else 0.0
        opacities = torch.where(lowered, factor * opacities, opacities)
    return replace(added, opacities=opacities, encoded=None)


def is_undone(added: Gaussians, harmless: Gaussians, config: HarmConfig = HarmConfig()) -> bool:
    """Whether so much of the opacity of what is `added` had to go, until it was `harmless`, that
    the photographs contradict all of it."""
    if config.max_loss is None:
        return False
    left = harmless.opacities.sum() / added.opacities.sum().clamp_min(1e-12)
    return len(added) > 0 and 1 - left.item() > config.max_loss


def most_harmful(relief: Float[Tensor, "n"], needed: float) -> Bool[Tensor, "n"]:
    """The fewest entries whose `relief` adds up to `needed`, or to half of all relief there is.

    Relief is a promise of first order. Where it cannot be enough, the worst go first and the rest
    are judged anew without them.
    """
    order = relief.argsort(descending=True, stable=True)
    positive = relief[order].clamp_min(0)
    enough = min(needed, positive.sum().item() / 2)
    chosen = torch.zeros_like(relief, dtype=torch.bool)
    chosen[order] = (positive.cumsum(0) - positive < enough) & (positive > 0)
    return chosen


def error_slope(
    plan: OpacityRender, photograph: Float[Tensor, "h w 3"], opacities: Float[Tensor, "n"]
) -> tuple[float, Float[Tensor, "n"]]:
    """Error against the photograph, and how it grows with each opacity."""
    with torch.enable_grad():
        variable = opacities.detach().clone().requires_grad_()
        image = plan(variable).image
        (slope,) = torch.autograd.grad((image - photograph).square().mean(), variable)
    return squared_error(image.detach(), photograph).item(), slope


def squared_error(image: Float[Tensor, "h w 3"], photograph: Float[Tensor, "h w 3"]) -> Tensor:
    """Mean squared error of the image as it is shown, clipped to [0, 1]."""
    return (image.clamp(0, 1) - photograph).square().mean()


def error_with_loss(error: float, decibel: float) -> float:
    """The mean squared error whose PSNR is `decibel` lower than that of `error`."""
    return error * 10 ** (decibel / 10)
