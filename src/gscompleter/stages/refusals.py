"""Targets that are not completed: what is said about those that are refused or see no hole."""

from __future__ import annotations

from gscompleter.config import HoleConfig
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.stages.target_view import TargetView

NOTHING_TO_COMPLETE = ": nothing to complete."
"""End of each sentence why a target is skipped that is not refused."""


def explain_refusal(view: TargetView) -> str | None:
    """Explain why a target cannot be completed; None if it can."""
    # The sky is no surface that anything could be registered to.
    covered = view.camera.crop(view.surfaces.valid).float().mean().item()
    return explain_little_covered(covered, view.state.config.holes)


def explain_skip(view: TargetView) -> str:
    """Explain why nothing is completed at a target, refusals included; empty if it can be."""
    return explain_refusal(view) or explain_no_need(view)


def explain_no_need(view: TargetView) -> str:
    """Explain why nothing has to be completed at a target; empty if it sees a hole."""
    unsure = view.camera.crop(view.holes | (view.distrust > 0))
    # At a context view, which of a splat alone is a render, Φ could only return its image. That is
    # no reason where its pixels are ignored, since nothing is known of them.
    target = view.camera.target
    same = [known for known in view.state.views if is_same_camera(target, known.camera)]
    if any(not (unsure & ~known.valid_mask).any() for known in same):
        return f"The scene is known at this camera already{NOTHING_TO_COMPLETE}"
    if not unsure.any():
        return f"The target sees no hole of the scene{NOTHING_TO_COMPLETE}"
    return ""


def explain_little_covered(covered: float, config: HoleConfig = HoleConfig()) -> str | None:
    """Explain that too small a share of a target's image is covered; None if it is enough."""
    if covered >= config.min_covered:
        return None
    return (
        f"The target sees surfaces of the scene in {covered:.1%} of its image, and at least "
        f"{config.min_covered:.0%} are needed; move it closer to the photographs, or turn it "
        "towards what they show."
    )
