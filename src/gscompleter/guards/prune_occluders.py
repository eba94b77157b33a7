"""Pruning of occluders: unobserved Gaussians that no photograph needs; they can be restored."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.guards.psnr import compute_mse_and_gradient, compute_squared_error, select_fewest
from gscompleter.render import FrozenScene, OpacityRender, Renderer, restrict_to_image
from gscompleter.types import Gaussians, View

MAX_TRIALS = 16
"""Rounds of putting back what a photograph needs most, before it gets back all that it sees."""
MAX_SINGLE_INCREASE = 1e-6
"""Relative increase of a photograph's squared error that one missing Gaussian may cause."""
GRADIENT_OPACITY = 0.1
"""Opacity factor at which gradients of missing Gaussians are evaluated; at 0 there are none."""


def find_unneeded(
    occluders: Gaussians, frozen_views: Iterable[FrozenScene], views: Sequence[View]
) -> Bool[Tensor, "n"]:
    """Find occluders that can be removed without any photograph getting worse.

    `around` is the scene without them, frozen at each photograph.
    """
    frozen, opacities = list(frozen_views), occluders.opacities
    measured = [
        compute_mse_and_gradient(
            restrict_to_image(view.vary_opacities(occluders)), photograph, opacities
        )
        for view, photograph in zip(frozen, views, strict=True)
    ]
    needed_alone = [
        -gradient * opacities > MAX_SINGLE_INCREASE * error for error, gradient in measured
    ]
    removable = ~torch.stack(needed_alone).any(dim=0)
    if not removable.any():
        return removable
    candidates, kept = occluders[removable], occluders[~removable]
    for k, view in enumerate(frozen):  # In place, to save memory.
        frozen[k] = view.extend(kept)
    plans = [view.vary_opacities(candidates) for view in frozen]
    unneeded = find_removable_together(
        candidates.opacities, lambda: plans, views, [error for error, _ in measured]
    )
    return removable.masked_scatter(removable, unneeded)


def exclude_needed(
    scene: Gaussians,
    removable: Bool[Tensor, "n"],
    views: Sequence[View],
    max_errors: Sequence[float],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """Remove needed Gaussians from a mask until every photograph is within its MSE limit."""
    candidates, rest = scene[removable], scene[~removable]

    def plans() -> Iterator[OpacityRender]:
        # One at a time, to save memory.
        return (renderer.freeze(rest, view.camera).vary_opacities(candidates) for view in views)

    unneeded = find_removable_together(candidates.opacities, plans, views, max_errors)
    return removable.masked_scatter(removable, unneeded)


def find_removable_together(
    opacities: Float[Tensor, "n"],
    plans: Callable[[], Iterable[OpacityRender]],
    views: Sequence[View],
    max_errors: Sequence[float],
) -> Bool[Tensor, "n"]:
    """Find Gaussians that can be missing together without any photograph exceeding its limit.

    Restored Gaussians may change other photographs, so all are checked until nothing changes.
    """
    missing = torch.ones_like(opacities, dtype=torch.bool)
    before = None
    while before is None or not torch.equal(missing, before):
        before = missing
        for plan, view, error in zip(plans(), views, max_errors, strict=True):
            missing = missing & ~find_needed(plan, opacities, missing, view, error)
    return missing


def find_needed(
    plan: OpacityRender,
    opacities: Float[Tensor, "n"],
    missing: Bool[Tensor, "n"],
    view: View,
    max_error: float,
) -> Bool[Tensor, "n"]:
    """Find the missing Gaussians that a photograph needs back to be within its limit."""
    back = torch.zeros_like(missing)
    for _ in range(MAX_TRIALS):
        absent = missing & ~back
        image = view.fill_ignored(plan(torch.where(absent, 0.0, opacities)).image)
        error = compute_squared_error(image, view.image).item()
        if error <= max_error or not absent.any():
            return back
        _, gradient = compute_mse_and_gradient(
            restrict_to_image(plan), view, torch.where(absent, GRADIENT_OPACITY, 1.0) * opacities
        )
        back = back | select_fewest(
            torch.where(absent, -gradient * opacities, 0.0), error - max_error
        )
    return back | (missing & (gradient != 0))


def compute_scene_error(scene: Gaussians, view: View, renderer: Renderer) -> Float[Tensor, ""]:
    """Compute the mean squared error of the scene against a photograph."""
    image = renderer.render(scene, view.camera).image
    return compute_squared_error(view.fill_ignored(image), view.image)
