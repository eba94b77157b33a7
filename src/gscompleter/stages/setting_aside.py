"""What stands in the way of a completion: Gaussians that nothing supports are set aside.

They are not edited and not lost: a scene without them goes on, and they can be put back. One that
a photograph needs always stays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.render import FrozenView, OpacityRender, Renderer, image_of
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
    doubtful: Gaussians, around: Iterable[FrozenView], views: Sequence[View]
) -> Bool[Tensor, "n"]:
    """Which of the `doubtful` Gaussians can go without any photograph being matched worse.

    Those that a photograph needs most stay, no more of them than it takes, until each is matched as
    well as by the whole scene.

    Args:
        doubtful: The n Gaussians.
        around: The scene without them, frozen at each photograph.
        views: The photographs.
    """
    frozen, opacities = list(around), doubtful.opacities
    told = [
        error_slope(image_of(view.plan(doubtful)), photograph, opacities)
        for view, photograph in zip(frozen, views, strict=True)
    ]
    missed = [-slope * opacities > LITTLE * error for error, slope in told]
    spare = ~torch.stack(missed).any(dim=0)
    if not spare.any():
        return spare
    candidates, kept = doubtful[spare], doubtful[~spare]
    for k, view in enumerate(frozen):  # None is held twice: they take much memory.
        frozen[k] = view.extended(kept)
    plans = [view.plan(candidates) for view in frozen]
    gone = all_gone(candidates.opacities, lambda: plans, views, [error for error, _ in told])
    return spare.masked_scatter(spare, gone)


def without_needed(
    scene: Gaussians,
    doubtful: Bool[Tensor, "n"],
    views: Sequence[View],
    allowed: Sequence[float],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """The `doubtful` Gaussians of `scene` but for those that a photograph needs most, no more of
    them than it takes for its mean squared error to be `allowed`."""
    candidates, rest = scene[doubtful], scene[~doubtful]

    def plans() -> Iterator[OpacityRender]:
        # One at a time: all of many photographs would not fit into memory.
        return (renderer.freeze(rest, view.camera).plan(candidates) for view in views)

    gone = all_gone(candidates.opacities, plans, views, allowed)
    return doubtful.masked_scatter(doubtful, gone)


def all_gone(
    opacities: Float[Tensor, "n"],
    plans: Callable[[], Iterable[OpacityRender]],
    views: Sequence[View],
    allowed: Sequence[float],
) -> Bool[Tensor, "n"]:
    """Which Gaussians can be missing together, as long as the error of every photograph is allowed.

    What is put back for one photograph may change another, so they are asked until all agree.

    Args:
        opacities: Those of the n Gaussians.
        plans: Gives what draws each of `views` with other opacities of them.
        views: The photographs.
        allowed: Largest mean squared error of each.
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
