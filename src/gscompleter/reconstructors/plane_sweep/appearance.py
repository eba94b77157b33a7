"""Opacities and colours that bring the Gaussians nearer to their photographs; geometry stays.

Pixels become Gaussians at the depth that stereo gave them, all of them opaque. Where two views
disagree, one of them stands in the other's way; drawn on top of each other they blur. A few steps
of descent tell which of the two to believe, and give the colours the sharpness that drawing takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from gscompleter.descent import Adam
from gscompleter.render import Renderer
from gscompleter.types import SH_C0, Gaussians, View, sh_from_rgb

OPACITY_STEPS = 6
"""Steps of Adam on the opacities, each by one of the photographs in turn."""
LEARNING_RATE = 1.0
"""Step of Adam, on the logit."""
BETAS = 0.7, 0.99
"""Decay of Adam's means: shorter than usual, as the steps are few."""
REMOVAL_PENALTY = 0.01
"""Cost of an opacity taken away, so that what no photograph objects to stays."""
COLOUR_STEPS = 4
"""Rounds of correcting the colours."""
RELAXATION = 1.7
"""How far a round goes, as a multiple of the mean difference; under 2 the rounds converge."""


def fit_appearance(gaussians: Gaussians, views: Sequence[View], renderer: Renderer) -> Gaussians:
    """`gaussians` with opacities and colours fitted to `views`."""
    return fit_colours(fit_opacities(gaussians, views, renderer), views, renderer)


def fit_opacities(gaussians: Gaussians, views: Sequence[View], renderer: Renderer) -> Gaussians:
    """The L1 difference from the photographs, plus a cost of whatever is taken away."""
    nothing = gaussians[:0]
    plans = [(renderer.freeze(nothing, v.camera).plan(gaussians), v.image) for v in views]
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


def fit_colours(gaussians: Gaussians, views: Sequence[View], renderer: Renderer) -> Gaussians:
    """Each colour moved, again and again, along the mean difference from the photographs.

    The mean is weighted by the share that the Gaussian has in each pixel: SIRT (Gilbert 1972), as
    the image is linear in the colours.
    """
    nothing, colours = gaussians[:0], gaussians.sh[:, 0] * SH_C0 + 0.5
    plans = [(renderer.freeze(nothing, v.camera).plan_colours(gaussians), v.image) for v in views]
    for _ in range(COLOUR_STEPS):
        sums, weights = zip(*(errors(colours, image) for errors, image in plans), strict=True)
        # What is hardly drawn is hardly known.
        drawn = torch.stack(weights).sum(0).clamp_min(0.05)
        colours = colours + RELAXATION * torch.stack(sums).sum(0) / drawn[:, None]
    return replace(gaussians, sh=sh_from_rgb(colours))
