"""The verdict on a completion for users of the Python interface."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.completer import check_state
from gscompleter.evaluation.verdict.held_out import HeldOut, score_context, score_held_out
from gscompleter.evaluation.verdict.outcome import judge_completion
from gscompleter.evaluation.verdict.rows import OutcomeRow
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.numerics.value_checks import check_views
from gscompleter.render.loading import load_renderer
from gscompleter.state import Completion
from gscompleter.system.errors import InputError
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import View


@run_in_plain_torch
def judge(completion: Completion, unused_views: Sequence[View] = ()) -> OutcomeRow:
    """Judge whether the scene reconstructed and whether anything was gained, as `complete` does.

    Args:
        completion: A completion with its targets.
        unused_views: Photographs of the place that are not part of the context, in the frame of its
            cameras. They decide; without any, only the features that the context photographs share
            can, which notices fewer errors.

    Returns:
        `status`, which is completed, nothing-gained or not-reconstructed, and the sentence
        `headline`.

    Raises:
        InputError: An unused view is none, or is a part of the context.
    """
    check_state(completion)
    held_out = prepare_held_out(completion, unused_views)
    renderer = load_renderer(completion.views[0].image.device.type)
    rows = score_held_out(completion, held_out, renderer)
    context = score_context(completion, renderer) if completion.is_given else []
    return judge_completion(completion, rows, context=context)


def prepare_held_out(completion: Completion, unused_views: Sequence[View]) -> list[HeldOut]:
    """Check photographs that score a completion, and give them its depth range; as in `judge`."""
    check_views(unused_views, "unused")
    device = completion.views[0].image.device
    held_out = []
    for number, view in enumerate(unused_views):
        if any(is_same_photograph(view, used) for used in completion.views):
            name = f"Unused view {number}"
            if view.frame is not None:
                name = f"The unused view of frame {view.frame}"
            raise InputError(
                f"{name} is part of the context, which cannot test itself; give photographs that "
                "were not used."
            )
        camera = completion.with_depth_range(view.camera)
        plain = View(view.image, camera, view.frame, ignore_mask=view.ignore_mask)
        held_out.append(HeldOut(plain.to(device)))
    return held_out


def is_same_photograph(view: View, other: View) -> bool:
    """Check whether views are one photograph: by their frames, or their cameras if one has none."""
    if view.frame is None or other.frame is None:
        return is_same_camera(view.camera, other.camera)
    return view.frame == other.frame
