"""What earlier edits of a splat took out of it, as the record beside its file says."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile, Target
from gscompleter.editing.taken_out import TakenOut
from gscompleter.render.protocols import Renderer
from gscompleter.splats.formats import load_splat, read_provenance
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.result_names import EDITS_FILE
from gscompleter.types import Gaussians, merge


def load_taken_out(splat_file: InputSplatFile) -> Gaussians | None:
    """Load what earlier edits took out of a splat, without colours by direction.

    The means are relative to the origin of the splat. None if nothing was taken out.
    """
    edits = splat_file.edits
    names = [edit.taken_out for edit in edits.edits if edit.taken_out is not None]
    if not names:
        return None
    parts = [load_splat(edits.find(name)) for name in names]
    gaussians = merge([replace(part, sh=part.sh[:, :1]) for part in parts])
    # Files have their own coordinates, and the splat of a task is relative to its origin.
    x, y, z = splat_file.origin.tolist()
    return replace(gaussians.move_origin((x, y, z)), origin=None)


def merge_taken_out(scene: Gaussians, splat_file: InputSplatFile) -> Gaussians:
    """Merge a splat with what earlier edits took out of it: the splat as it was."""
    taken_out = load_taken_out(splat_file)
    return scene if taken_out is None else merge([scene, taken_out.to(scene.means.device)])


def take_over_edits(
    task: CompletionTask, forgets: bool, renderer: Renderer
) -> tuple[CompletionTask, tuple[str, ...]]:
    """Hide what earlier edits took out in all photographs of a task, unless it `forgets` them.

    Also returns the lines for the user. The task has an input splat.
    """
    assert task.scene is not None
    assert task.splat_file is not None
    notes = describe_taken_out(task.splat_file, forgets)
    gaussians = None if forgets else load_taken_out(task.splat_file)
    if gaussians is None:
        return task, notes
    # What was invented since fills its place, and would hide it.
    occluders = task.scene.hide(task.scene.generated != 0)
    taken_out = TakenOut(gaussians.to(task.device), task.scene, occluders, renderer)
    return hide_taken_out(replace(task, taken_out=taken_out)), notes


def describe_taken_out(splat_file: InputSplatFile, forgets: bool) -> tuple[str, ...]:
    """Write the lines on what earlier edits took out of a splat, and on edits without a record."""
    path = splat_file.path
    edits = splat_file.edits
    count = sum(edit.taken_out is not None for edit in edits.edits)
    if not edits and (runs := count_runs(path)):
        return (
            f"{quote_value(path)} was edited {runs} times, and there is no {EDITS_FILE} beside it. "
            "What was removed is not known, so that photographs may bring it back.",
        )
    if not count:
        return ()
    removals = "1 removal" if count == 1 else f"{count} removals"
    if forgets:
        return (f"{removals} of this splat forgotten: photographs may bring back what went.",)
    is_kept = "is" if count == 1 else "are"
    return (
        f"{removals} of this splat {is_kept} kept: photographs are ignored where they show what "
        "went (--forget-edits uses them).",
    )


def count_runs(path: Path) -> int:
    """Count the runs that a splat names as its makers; 0 if its record is damaged."""
    with suppress(InputError):
        return len(read_provenance(path).runs)
    return 0


def hide_taken_out(task: CompletionTask) -> CompletionTask:
    """Hide what was taken out in all photographs of a task with a splat; nothing if nothing was."""
    taken_out = task.taken_out
    if taken_out is None:
        return task
    if task.is_remade:
        # The scene was right from its own photographs alone. From others, what it has before the
        # place may not be there, and what went would come back through it.
        taken_out = replace(taken_out, occluders=taken_out.scene[:0])
    return replace(
        task,
        taken_out=taken_out,
        views=[taken_out.hide(view) for view in task.views],
        check_views=[taken_out.hide(view) for view in task.check_views or ()],
        targets=[hide_in_target(target, taken_out) for target in task.targets],
    )


def hide_in_target(target: Target, taken_out: TakenOut) -> Target:
    """Ignore the pixels that show it in the photograph of a target.

    Unlike `TakenOut.hide` it paints nothing over: the photograph only scores the result.
    """
    if target.photograph is None:
        return target
    mask = taken_out.find(target.camera.to(taken_out.scene.means.device))
    mask = mask.to(target.photograph.device)
    if target.ignore_mask is not None:
        mask = mask | target.ignore_mask
    return replace(target, ignore_mask=mask)
