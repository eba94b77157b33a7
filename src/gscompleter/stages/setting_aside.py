"""What stands in the way of a completion: Gaussians that nothing supports are set aside.

They are not edited and not lost: a scene without them goes on, and they can be put back. One that
a photograph needs always stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.render import OpacityRender, Renderer, image_of
from gscompleter.stages.harm import error_slope, fewest, squared_error
from gscompleter.types import Gaussians, View

MAX_TRIALS = 16
"""How often what a photograph needs most is put back, before it gets back all that it sees."""
LITTLE = 1e-6
"""Share of its squared error by which a photograph may miss a Gaussian by itself."""
FADED = 0.1
"""Share of its opacity at which a missing Gaussian is asked what more of it would change. Without
any it would not be drawn, and would tell nothing."""


def not_needed(
    scene: Gaussians, doubtful: Bool[Tensor, "n"], views: Sequence[View], renderer: Renderer
) -> Bool[Tensor, "n"]:
    """The `doubtful` Gaussians of `scene` without which no photograph is matched worse.

    Those that a photograph needs most are put back, no more of them than it takes, until each is
    matched as well as by the whole scene.
    """
    doubtful = doubtful & ~wanted(scene, doubtful, views, renderer)
    if not doubtful.any():
        return doubtful
    allowed = [error_of(scene, view, renderer).item() for view in views]
    return without_needed(scene, doubtful, views, allowed, renderer)


def without_needed(
    scene: Gaussians,
    doubtful: Bool[Tensor, "n"],
    views: Sequence[View],
    allowed: Sequence[float],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """The `doubtful` Gaussians but for those that a photograph needs most, no more of them than it
    takes for its mean squared error to be `allowed`.

    What is put back for one photograph may change another, so they are asked until all agree.
    """
    candidates, rest = scene[doubtful], scene[~doubtful]
    missing = torch.ones(len(candidates), dtype=torch.bool, device=doubtful.device)
    before = None
    while before is None or not torch.equal(missing, before):
        before = missing
        for view, error in zip(views, allowed, strict=True):
            # One at a time: all of many photographs would not fit into memory.
            plan = renderer.freeze(rest, view.camera).plan(candidates)
            missing = missing & ~needed(plan, candidates.opacities, missing, view, error)
    return doubtful.masked_scatter(doubtful, missing)


def wanted(
    scene: Gaussians, doubtful: Bool[Tensor, "n"], views: Sequence[View], renderer: Renderer
) -> Bool[Tensor, "n"]:
    """Which of the `doubtful` Gaussians some photograph would miss by itself."""
    candidates, rest = scene[doubtful], scene[~doubtful]
    missed = torch.zeros(len(candidates), dtype=torch.bool, device=doubtful.device)
    for view in views:
        plan = renderer.freeze(rest, view.camera).plan(candidates)
        error, slope = error_slope(image_of(plan), view, candidates.opacities)
        missed |= -slope * candidates.opacities > LITTLE * error
    result = doubtful.clone()
    result[doubtful] = missed
    return result


def needed(
    plan: OpacityRender,
    opacities: Float[Tensor, "n"],
    missing: Bool[Tensor, "n"],
    view: View,
    allowed: float,
) -> Bool[Tensor, "n"]:
    """Which of the Gaussians that are `missing` a photograph needs back, so that its mean squared
    error is not above `allowed`."""
    back = torch.zeros_like(missing)
    for _ in range(MAX_TRIALS):
        out = missing & ~back
        image = view.compared(plan(torch.where(out, 0.0, opacities)).image)
        error = squared_error(image, view.image).item()
        if error <= allowed or not out.any():
            return back
        _, slope = error_slope(image_of(plan), view, torch.where(out, FADED, 1.0) * opacities)
        back = back | fewest(torch.where(out, -slope * opacities, 0.0), error - allowed)
    return back | (missing & (slope != 0))


def error_of(scene: Gaussians, view: View, renderer: Renderer) -> Float[Tensor, ""]:
    """Mean squared error of the scene against a photograph."""
    image = renderer.render(scene, view.camera).image
    return squared_error(view.compared(image), view.image)
