"""Opacities and colours fitted to two photographs; the geometry stays fixed.

Stereo gives every pixel an opaque Gaussian; views that disagree on a surface occlude each other. A
few gradient steps fade the wrong Gaussians and sharpen the colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from gscompleter.optim import Adam
from gscompleter.render import Renderer
from gscompleter.types import SH_C0, Gaussians, View, sh_from_rgb

OPACITY_STEPS = 6
"""Adam steps on the opacities; each step uses one photograph, in turn."""
LEARNING_RATE = 1.0
BETAS = 0.7, 0.99
"""Adam decay rates, short because there are few steps."""
REMOVAL_PENALTY = 0.01
"""Loss per unit of removed opacity; keeps Gaussians that no photograph contradicts."""
COLOR_STEPS = 4
"""Iterations of the colour correction."""
RELAXATION = 1.7
"""Step size as a multiple of the mean residual; below 2 the iterations converge."""


def fit_appearance(gaussians: Gaussians, views: Sequence[View], renderer: Renderer) -> Gaussians:
    """Fit opacities, then colours, to the photographs."""
    return fit_colors(fit_opacities(gaussians, views, renderer), views, renderer)


def fit_opacities(gaussians: Gaussians, views: Sequence[View], renderer: Renderer) -> Gaussians:
    """Minimize the L1 image difference plus a penalty on removed opacity."""
    nothing = gaussians[:0]
    plans = [(renderer.freeze(nothing, v.camera).vary_opacities(gaussians), v.image) for v in views]
    logits = gaussians.opacities.logit(eps=1e-4).requires_grad_()
    optimizer = Adam([(logits, LEARNING_RATE)], BETAS)
    weight = REMOVAL_PENALTY * len(views) / len(gaussians)
    for step in range(OPACITY_STEPS):
        plan, image = plans[step % len(plans)]
        opacities = logits.sigmoid()
        removed = (gaussians.opacities - opacities).clamp_min(0).sum()
        difference = (plan(opacities).image - image).abs().mean()
        optimizer.step(len(views) * difference + weight * removed)
    return replace(gaussians, opacities=logits.detach().sigmoid())


def fit_colors(gaussians: Gaussians, views: Sequence[View], renderer: Renderer) -> Gaussians:
    """Fit the colours by SIRT (Gilbert 1972), as the image is linear in them."""
    nothing, colours = gaussians[:0], gaussians.sh[:, 0] * SH_C0 + 0.5
    plans = [(renderer.freeze(nothing, v.camera).vary_colors(gaussians), v.image) for v in views]
    for _ in range(COLOR_STEPS):
        sums, weights = zip(*(errors(colours, image) for errors, image in plans), strict=True)
        # The lower bound damps Gaussians that hardly contribute to any image.
        total = torch.stack(weights).sum(0).clamp_min(0.05)
        colours = colours + RELAXATION * torch.stack(sums).sum(0) / total[:, None]
    return replace(gaussians, sh=sh_from_rgb(colours))
