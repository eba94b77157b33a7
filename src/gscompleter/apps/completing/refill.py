"""Targets of earlier commands at which holes opened again (decision 151)."""

from __future__ import annotations

from dataclasses import replace

from gscompleter.apps.completing.preparation import compute_view_transform
from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.inputs.earlier_targets import read_earlier_targets
from gscompleter.apps.inputs.named_photographs import add_photograph
from gscompleter.apps.inputs.taken_out import hide_in_target
from gscompleter.apps.inputs.task import Target
from gscompleter.evaluation.metrics.coverage import compute_covered_share
from gscompleter.evaluation.verdict.numbers import format_percent
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.splats.alignment.similarity import transform_camera
from gscompleter.state import Completion
from gscompleter.types import Camera

MIN_REOPENED = 1e-3
"""Share of an image in new holes from which on a target is filled again: 275 pixels of 640 x 427.
What a target is filled for again takes seconds, and fewer are hardly seen."""
REOPENED = (
    "Filled again: an earlier command had filled the holes of this camera, and now {share} of "
    "its image was empty."
)


def find_reopened(ready: Prepared, completion: Completion) -> tuple[Target, ...]:
    """Find the targets of earlier commands at which more is empty now than these had left.

    There are none without an input splat, without photographs, where edits are forgotten, and
    where something is taken out by this command, which opens holes on purpose. A camera of the
    context or of a target of this command is none either.
    """
    work = ready.work
    task = ready.task
    opened = ready.opened
    is_alone = opened.renders_from is not None
    if work.splat is None or work.splat.forget_edits or task.splat_file is None or is_alone:
        return ()
    if ready.choose_gone is not None:
        return ()
    earlier = read_earlier_targets(
        task.splat_file.edits,
        opened.files,
        opened.request.resolution,
        opened.photographs.origin,
    )
    transform = compute_view_transform(opened, task)
    found = []
    for target in earlier:
        moved = transform_camera(target.camera, transform).to(task.device)
        camera = completion.with_depth_range(moved)
        if any(is_same_camera(camera, known) for known in task.cameras):
            continue
        render = ready.completer.scenes.freeze(completion.parts, camera).render
        share = 1 - compute_covered_share([render])
        if share >= target.empty_share + MIN_REOPENED:
            found.append(make_reopened(ready, camera, share))
    return tuple(found)


def make_reopened(ready: Prepared, camera: Camera, share: float) -> Target:
    """Make the target of a camera at which holes opened, with its photograph if it has one."""
    reason = REOPENED.format(share=format_percent(share))
    frame = find_frame_taken_by(ready, camera)
    if frame is None:
        return Target(camera, reason=reason)
    photographs = ready.opened.photographs
    target = add_photograph(Target(camera, frame), photographs, ready.opened.request.resolution)
    if ready.task.taken_out is not None:
        target = hide_in_target(target, ready.task.taken_out)
    return replace(target, reason=reason)


def find_frame_taken_by(ready: Prepared, camera: Camera) -> int | None:
    """Find the frame of the photograph that was taken by a camera; None if there is none."""
    taken = (frame for frame, known in ready.cameras.items() if is_same_camera(known, camera))
    return next(taken, None)
