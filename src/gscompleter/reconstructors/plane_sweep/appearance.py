"""Opacities and colours that bring the Gaussians nearer to their photographs; geometry stays.

Pixels become Gaussians at the depth that stereo gave them, all of them opaque. Where two views
disagree, one of them stands in the other's way; drawn on top of each other they blur. A few steps
of descent tell which of the two to believe, and give the colours the sharpness that drawing takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.render import Renderer
from gscompleter.types import SH_C0, Gaussians, View


@dataclass(frozen=True)
class AppearanceConfig:
    opacity_steps: int = 15
    """Steps of Adam on the opacities; 0 leaves them."""
    learning_rate: float = 0.4
    """Step of Adam, on the logit."""
    removal_penalty: float = 0.01
    """Cost of an opacity taken away, so that what no photograph objects to stays."""
    colour_steps: int = 4
    """Rounds of correcting the colours; 0 leaves them."""


def fit_appearance(
    gaussians: Gaussians,
    views: Sequence[View],
    renderer: Renderer,
    config: AppearanceConfig = AppearanceConfig(),
) -> Gaussians:
    """`gaussians` with opacities and colours fitted to `views`."""
    fitted = fit_opacities(gaussians, views, renderer, config)
    return fit_colours(fitted, views, renderer, config)


def fit_opacities(
    gaussians: Gaussians, views: Sequence[View], renderer: Renderer, config: AppearanceConfig
) -> Gaussians:
    """The L1 difference from the photographs, plus a cost of whatever is taken away."""
    nothing = gaussians[:0]
    plans = [(renderer.freeze(nothing, v.camera).plan(gaussians), v.image) for v in views]
    logits = gaussians.opacities.logit(eps=1e-4).requires_grad_()
    optimizer = torch.optim.Adam([logits], lr=config.learning_rate)
    weight = config.removal_penalty * len(views) / len(gaussians)
    for _ in range(config.opacity_steps):
        opacities = logits.sigmoid()
        removed = (gaussians.opacities - opacities).clamp_min(0).sum()
        terms = [(plan(opacities).image - image).abs().mean() for plan, image in plans]
        loss = torch.stack([*terms, weight * removed]).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return replace(gaussians, opacities=logits.detach().sigmoid())


def fit_colours(
    gaussians: Gaussians, views: Sequence[View], renderer: Renderer, config: AppearanceConfig
) -> Gaussians:
    """Each colour moved, again and again, by the mean difference from the photographs.

    The mean is weighted by the share that the Gaussian has in each pixel: SIRT (Gilbert 1972), as
    the image is linear in the colours.
    """
    sh, drawn = gaussians.sh.detach().clone(), torch.zeros_like(gaussians.opacities)
    for step in range(config.colour_steps):
        moved = torch.zeros_like(sh[:, 0])
        for view in views:
            colours = sh.clone().requires_grad_()
            image = renderer.render(replace(gaussians, sh=colours), view.camera).image
            moved += backprojected(image, view.image - image.detach(), colours)
            if step == 0:
                drawn += backprojected(image, torch.ones_like(image), colours).mean(dim=-1)
        # What is hardly drawn is hardly known.
        sh[:, 0] += moved / drawn.clamp_min(0.05)[:, None] / SH_C0
    return replace(gaussians, sh=sh)


def backprojected(
    image: Float[Tensor, "h w 3"], values: Float[Tensor, "h w 3"], sh: Float[Tensor, "n k 3"]
) -> Float[Tensor, "n 3"]:
    """The sum of `values` over the pixels each Gaussian is drawn on, by its share of them."""
    (slope,) = torch.autograd.grad(image, sh, values, retain_graph=True)
    return slope[:, 0] / SH_C0
