"""Gaussians of many views, brought nearer to all photographs at once.

What several views measured lies a fraction of a pixel off in some of them. So not only opacities
and colours are fitted here, as for two views, but places, sizes and directions too, a few views at
a time, so that the time grows with the number of photographs only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gscompleter.render import Renderer
from gscompleter.types import Gaussians, View

PASSES = 20
"""How often each photograph is asked."""
VIEWS_PER_STEP = 2
"""Photographs asked in one step."""
RATES = {"moved": 0.1, "quats": 0.01, "grown": 0.05, "logits": 0.2, "sh": 0.03}
"""Steps of Adam: on the place, in units of the Gaussian's own size; on the quaternion; on the
logarithm of the size; on the logit of the opacity; and on the colour."""
FAINTEST = 0.02
"""Opacity below which a Gaussian has faded."""


def fit_jointly(gaussians: Gaussians, views: Sequence[View], renderer: Renderer) -> Gaussians:
    """`gaussians` fitted to `views` by the squared difference."""
    unknown = unknowns(gaussians)
    optimizer = torch.optim.Adam([{"params": [unknown[k]], "lr": lr} for k, lr in RATES.items()])
    for numbers in minibatches(len(views)):
        fitted = moved_by(gaussians, unknown)
        errors = [
            (renderer.render(fitted, views[i].camera).image - views[i].image).square().mean()
            for i in numbers
        ]
        optimizer.zero_grad()
        torch.stack(errors).sum().backward()
        optimizer.step()
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


def minibatches(count: int) -> list[list[int]]:
    """Numbers of the views that are asked together: each view PASSES times, in random order."""
    generator = torch.Generator().manual_seed(0)
    order = torch.cat([torch.randperm(count, generator=generator) for _ in range(PASSES)])
    return [part.tolist() for part in order.split(VIEWS_PER_STEP)]
