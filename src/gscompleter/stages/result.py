"""The result of a target, before and after something was added for it."""

from __future__ import annotations

from dataclasses import dataclass

from gscompleter.parts import Part
from gscompleter.stages.refusals import explain_no_need, explain_refusal
from gscompleter.stages.select_anchor import Anchor
from gscompleter.stages.target_view import TargetView
from gscompleter.state import Completion
from gscompleter.target_result import TargetResult


@dataclass(frozen=True)
class TargetOutcome:
    """Hold the scene after a target, the result, and what was added."""

    state: Completion
    """The scene in its new colours, without what was added for the target."""
    result: TargetResult
    parts: tuple[Part, ...] = ()
    """Parts that were added for the target, in the order of addition."""


def make_unchanged_result(view: TargetView, anchor: Anchor) -> TargetResult:
    """Make the result of a target at which nothing was changed."""
    before = view.render.crop(view.camera)
    refusal = explain_refusal(view)
    return TargetResult(
        target=view.camera.target,
        before=before,
        after=before,
        hole_mask=view.camera.crop(view.holes),
        trusted_alpha=view.camera.crop(view.alpha),
        anchor=anchor.index,
        anchor_fallback=anchor.is_fallback,
        added=view.state.rendered_context[:0],
        refusal=refusal,
        skip_reason=refusal or explain_no_need(view),
        target_id=view.state.next_target_id,
    )
