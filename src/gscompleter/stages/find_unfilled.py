"""Pixels of the hole mask that a completion leaves empty, and the step that lost them."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.numerics.image_ops import find_largest_regions
from gscompleter.stages.additions import Step
from gscompleter.stages.fade_border import find_fading_border
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.stages.target_view import TargetView
from gscompleter.target_result import Unfilled
from gscompleter.types import Render

LOSSES = {
    "lift": "no depth was found for it",
    "register": "what was made for it did not fit there",
    "filter": "what was made for it lies beside the hole",
    "refine": "the photographs beside it contradict a filling",
}
"""Why each step of the paper leaves a part of a hole empty; a guard explains its own losses."""


def find_unfilled(after: Render, steps: Sequence[Step], view: TargetView) -> Unfilled:
    """Find the pixels of the dilated hole mask that are still holes after a target.

    `after` is the result at the padded camera, `steps` are the new Gaussians after each step, in
    order. The steps are rendered only if more than `Unfilled.MAX_SHARE` stays empty.
    """
    holes = view.state.config.holes
    # Towards the end of the padding additions fade on purpose.
    mask = view.addition_mask & ~find_fading_border(view)
    empty = mask & compute_hole_mask(after.alpha, holes)
    total = max(int(mask.sum()), 1)
    share = int(empty.sum()) / total
    if share <= Unfilled.MAX_SHARE:
        return Unfilled(share)

    # Each empty pixel is put down to the first step after which it is open. A later step is not
    # to blame, since there was nothing left for it to lose.
    lost: dict[str, float] = {}
    reasons: dict[str, str] = {}
    unexplained = empty
    for step in steps:
        alpha = view.frozen.composite(step.gaussians).alpha
        is_open = compute_hole_mask(alpha, holes)
        lost[step.name] = int((unexplained & is_open).sum()) / total
        reasons[step.name] = explain_loss(step)
        unexplained = unexplained & ~is_open
    lost = {name: part for name, part in lost.items() if part > 0}
    reason = reasons[max(lost, key=lambda name: lost[name])] if lost else ""
    regions = find_largest_regions(empty, -view.camera.left, -view.camera.top)
    return Unfilled(share, lost, regions, reason)


def explain_loss(step: Step) -> str:
    """Explain in a clause why a step leaves a part of a hole empty."""
    return step.loss or LOSSES.get(step.name, f"the step {step.name} left it out")
