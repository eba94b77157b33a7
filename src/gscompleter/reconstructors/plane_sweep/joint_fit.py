"""Gaussians of many views, brought nearer to all photographs at once.

What several views measured lies a fraction of a pixel off in some of them. So not only opacities
and colours are fitted here, as for two views, but places, sizes and directions too; one photograph
a step, so that the time grows with their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.descent import Adam
from gscompleter.render import Renderer
from gscompleter.types import Gaussians, View

PASSES = 10
"""How often each photograph is asked."""
RATES = {"moved": 0.2, "quats": 0.0375, "grown": 0.1875, "logits": 0.75, "sh": 0.1125}
"""First steps of Adam: on the place, in units of the Gaussian's own size; on the quaternion; on the
logarithm of the size; on the logit of the opacity; and on the colour."""
LAST = 0.2
"""What is left of these steps in the end; they shrink evenly."""
BETAS = 0.9, 0.99
"""Decay of Adam's means: shorter than usual, as the steps are few."""
FAINTEST = 0.02
"""Opacity below which a Gaussian has faded."""


def fit_jointly(
    gaussians: Gaussians,
    views: Sequence[View],
    gains: Float[Tensor, "views 3"],
    renderer: Renderer,
) -> Gaussians:
    """`gaussians` fitted to `views` by the squared difference, once what is drawn is exposed as
    each view is: brighter by its gain."""
    unknown = unknowns(gaussians)
    optimizer = Adam([(unknown[name], rate) for name, rate in RATES.items()], BETAS)
    order = order_of(len(views))
    for step, number in enumerate(order):
        view, fitted = views[number], moved_by(gaussians, unknown)
        image = renderer.render(fitted, view.camera).image
        left = 1 - (1 - LAST) * step / len(order)
        optimizer.step((gains[number] * image - view.image).square().mean(), left)
    return moved_by(gaussians, {name: value.detach() for name, value in unknown.items()})


def unknowns(gaussians: Gaussians) -> dict[str, Tensor]:
    """What is fitted, by the names of RATES."""
    start = {
        "moved": torch.zeros_like(gaussians.means),
        "quats": gaussians.quats,
        "grown": torch.zeros_like(gaussians.scales),
        "logits": gaussians.opacities.logit(eps=FAINTEST),
        "sh": gaussians.sh,
    }
    return {name: value.detach().clone().requires_grad_() for name, value in start.items()}


def moved_by(gaussians: Gaussians, unknown: dict[str, Tensor]) -> Gaussians:
    """`gaussians` changed by what was found so far."""
    size = gaussians.scales.amax(dim=-1, keepdim=True)
    return replace(
        gaussians,
        means=gaussians.means + size * unknown["moved"],
        quats=unknown["quats"],
        scales=gaussians.scales * unknown["grown"].exp(),
        opacities=unknown["logits"].sigmoid(),
        sh=unknown["sh"],
    )


def order_of(count: int) -> list[int]:
    """Whose turn it is: each of `count` views PASSES times, in random order."""
    generator = torch.Generator().manual_seed(0)
    rounds = [torch.randperm(count, generator=generator) for _ in range(PASSES)]
    return torch.cat(rounds).tolist()
