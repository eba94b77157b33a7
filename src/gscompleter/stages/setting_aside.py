"""Pruning of occluders: unobserved Gaussians that no photograph needs; they can be restored."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.render import FrozenView, OpacityRender, Renderer, image_of
from gscompleter.stages.harm import error_slope, fewest, squared_error
from gscompleter.types import Gaussians, View

MAX_TRIALS = 16
"""Rounds of putting back what a photograph needs most, before it gets back all that it sees."""
LITTLE = 1e-6
"""Relative increase of a photograph's squared error that one missing Gaussian may cause."""
FADED = 0.1
"""Opacity factor at which gradients of missing Gaussians are evaluated; at 0 there are none."""


def not_needed(
    doubtful: Gaussians, around: Iterable[FrozenView], views: Sequence[View]
) -> Bool[Tensor, "n"]:
    """Find occluders that can be removed without any photograph getting worse.

    `around` is the scene without them, frozen at each photograph.
    """
    frozen, opacities = list(around), doubtful.opacities
    measured = [
        error_slope(image_of(view.plan(doubtful)), photograph, opacities)
        for view, photograph in zip(frozen, views, strict=True)
    ]
    needed_alone = [-gradient * opacities > LITTLE * error for error, gradient in measured]
    removable = ~torch.stack(needed_alone).any(dim=0)
    if not removable.any():
        return removable
    candidates, kept = doubtful[removable], doubtful[~removable]
    for k, view in enumerate(frozen):  # In place, to save memory.
        frozen[k] = view.extended(kept)
    plans = [view.plan(candidates) for view in frozen]
    unneeded = all_gone(
        candidates.opacities, lambda: plans, views, [error for error, _ in measured]
    )
    return removable.masked_scatter(removable, unneeded)


def without_needed(
    scene: Gaussians,
    doubtful: Bool[Tensor, "n"],
    views: Sequence[View],
    allowed: Sequence[float],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """Remove needed Gaussians from a mask until every photograph is within its MSE limit."""
    candidates, rest = scene[doubtful], scene[~doubtful]

    def plans() -> Iterator[OpacityRender]:
        # One at a time, to save memory.
        return (renderer.freeze(rest, view.camera).plan(candidates) for view in views)

    unneeded = all_gone(candidates.opacities, plans, views, allowed)
    return doubtful.masked_scatter(doubtful, unneeded)


def all_gone(
    opacities: Float[Tensor, "n"],
    plans: Callable[[], Iterable[OpacityRender]],
    views: Sequence[View],
    allowed: Sequence[float],
) -> Bool[Tensor, "n"]:
    """Find Gaussians that can be missing together without any photograph exceeding its limit.

    Restored Gaussians may change other photographs, so all are checked until nothing changes.
    """
    missing = torch.ones_like(opacities, dtype=torch.bool)
    before = None
    while before is None or not torch.equal(missing, before):
        before = missing
        for plan, view, error in zip(plans(), views, allowed, strict=True):
            missing = missing & ~needed(plan, opacities, missing, view, error)
    return missing


def needed(
    plan: OpacityRender,
    opacities: Float[Tensor, "n"],
    missing: Bool[Tensor, "n"],
    view: View,
    allowed: float,
) -> Bool[Tensor, "n"]:
    """Find the missing Gaussians that a photograph needs back to be within its limit."""
    back = torch.zeros_like(missing)
    for _ in range(MAX_TRIALS):
        absent = missing & ~back
        image = view.compared(plan(torch.where(absent, 0.0, opacities)).image)
        error = squared_error(image, view.image).item()
        if error <= allowed or not absent.any():
            return back
        _, gradient = error_slope(image_of(plan), view, torch.where(absent, FADED, 1.0) * opacities)
        back = back | fewest(torch.where(absent, -gradient * opacities, 0.0), error - allowed)
    return back | (missing & (gradient != 0))


def error_of(scene: Gaussians, view: View, renderer: Renderer) -> Float[Tensor, ""]:
    """Compute the mean squared error of the scene against a photograph."""
    image = renderer.render(scene, view.camera).image
    return squared_error(view.compared(image), view.image)
