"""Steps of a method on a task: one target after the other, into the same scene.

After each step the photograph of its target is known and may be the anchor of a later step. With
the generator `oracle` that photograph also stands in place of the synthesized image: then all
images are true, and only their registration is compared, as in the paper's comparison with RegGS.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from gscompleter.data.sfm.refining import PoseRefinement
from gscompleter.evaluation import store
from gscompleter.evaluation.gap_pictures import draw_gap
from gscompleter.evaluation.memory import measure_peak_memory
from gscompleter.evaluation.methods import METHODS, Models, Prediction, mark_target
from gscompleter.evaluation.metrics import scores as scoring
from gscompleter.stages.lift import lift_pair
from gscompleter.state import Completion
from gscompleter.system.errors import InputError, OutputError
from gscompleter.system.files.image import write_image, write_pixels
from gscompleter.types import DepthMap, Gaussians, View

T = TypeVar("T")


@dataclass(frozen=True)
class PreparedTask:
    """A task with the data that all methods share; cameras have the depth range of the scene."""

    context: Gaussians
    views: tuple[View, ...]
    targets: tuple[View, ...]
    neighbours: tuple[View, ...]
    """Photographs beside the targets, for scoring only."""
    models: Models
    seconds: float
    """Wall time of the reconstruction of the context."""
    context_notes: tuple[str, ...] = ()
    """Sentences of Ψ on the photographs, such as on a depth that it did not use."""
    poses: PoseRefinement | None = None
    """What was done to the poses of the scene; None for nothing."""


@dataclass(frozen=True)
class SequenceStep:
    """Result of a method for one target."""

    frame: int
    """Frame of the target."""
    anchor: int | None
    """Anchor frame, or None if nothing is lifted or a render is the anchor."""
    anchor_fallback: bool
    """True if every view was rotated too far, so that the least rotated one is the anchor."""
    scores: scoring.Scores
    psnr_end: float | None
    """PSNR at the target, in dB, of the final scene of the task; None while the task runs."""
    depth_scale: float | None
    """See `scores.compute_depth_scale`; None in a task of one step or for too few pixels."""
    added: int
    """Number of Gaussians in the scene after the step, less those before it."""
    gaussians: int
    """Number of Gaussians in the scene after the step."""
    seconds: dict[str, float]
    """Wall time of each stage."""
    peak_bytes: int | None


@dataclass(frozen=True)
class TaskProgress:
    """The steps of a task so far, and the reason why it stopped."""

    scene: Gaussians
    views: tuple[View, ...]
    steps: tuple[SequenceStep, ...] = ()
    error: str | None = None


def complete_task(task: PreparedTask, method: str, folder: Path) -> TaskProgress:
    """Complete targets in order until a step fails; saved steps in `folder` are read back."""
    progress = TaskProgress(task.context, task.views)
    for number, view in enumerate(task.views, start=1):
        write_image(store.get_photograph_path(folder, number), view.image)
    for target in task.targets:
        following = attempt(partial(advance_task, progress, target, task, method, folder))
        if isinstance(following, str):
            progress = replace(progress, error=f"Frame {target.frame}: {following}")
            break
        progress = following

    # Later steps change what is seen at earlier targets, so all are scored once more at the end.
    # After a failure, there are fewer steps than targets.
    steps = []
    for step, target in zip(progress.steps, task.targets, strict=False):
        image = task.models.renderer.render(progress.scene, target.camera).image
        steps.append(replace(step, psnr_end=scoring.compute_view_psnr(image, target)))
    return replace(progress, steps=tuple(steps))


def advance_task(
    progress: TaskProgress, target: View, task: PreparedTask, method: str, folder: Path
) -> TaskProgress:
    """Complete one more target and save its prediction and images."""
    number = len(progress.steps) + 1
    # Begun anew from the scene and the photographs so far, so that the photograph of an earlier
    # target may be the anchor.
    state = task.models.make_completer().begin(progress.views, progress.scene)
    path = store.get_step_path(folder, method, number)
    if not store.is_complete(path):
        with measure_peak_memory(state.scene.means.device) as peak:
            computed = METHODS[method](state, target.camera, task.models)
        marked = mark_target(computed, number, state.scene)
        store.save_prediction(path, replace(marked, peak_bytes=peak.bytes))
    # Always read back, so that a resumed run continues with the same tensors.
    prediction = store.load_prediction(path, state.scene)
    step, seen = score_step(prediction, state, target, task)
    write_image(path.with_suffix(".png"), seen.after.image)
    write_image(path.with_name(f"before-{number:03d}.png"), seen.before.image)
    write_image(path.with_name(f"holes-{number:03d}.png"), seen.holes)
    write_pixels(path.with_name(f"gaps-{number:03d}.png"), draw_gap(seen.worst_gap))
    write_image(store.get_truth_path(folder, number), target.image)
    return TaskProgress(prediction.scene, (*progress.views, target), (*progress.steps, step))


def score_step(
    prediction: Prediction, state: Completion, target: View, task: PreparedTask
) -> tuple[SequenceStep, scoring.TargetRenders]:
    """Score a step, and return what was rendered at and near its target."""
    truth = scoring.Truth(state.views, target, task.neighbours)
    before = state.scene
    after = prediction.scene
    scores, seen = scoring.score(
        before, after, prediction.added, truth, task.models.renderer, prediction.registered
    )

    anchor = None if prediction.anchor is None else state.views[prediction.anchor]
    scale = None
    # In a sequence, an error of scale would grow from step to step; one step cannot show that.
    if len(task.targets) > 1 and anchor is not None and prediction.added is not None:
        expected = find_expected_depth(target, anchor, task.models)
        scale = scoring.compute_depth_scale(
            prediction.added, seen.holes, target.camera, expected, task.models.renderer
        )

    assert target.frame is not None
    step = SequenceStep(
        frame=target.frame,
        anchor=None if anchor is None else anchor.frame,
        anchor_fallback=prediction.anchor_fallback,
        scores=scores,
        psnr_end=None,
        depth_scale=scale,
        added=len(after) - len(before),
        gaussians=len(after),
        seconds=dict(prediction.seconds),
        peak_bytes=prediction.peak_bytes,
    )
    # Only for its error: NaN and infinity have no place in JSON, and fail this step here instead
    # of the file of all steps later.
    json.dumps(asdict(step), allow_nan=False)
    return step, seen


def find_expected_depth(target: View, anchor: View, models: Models) -> DepthMap:
    """Find the depth that an added surface should have: measured, or else as Ψ estimates it.

    A scale against an estimate is not absolute, but relative to that of the model.
    """
    if target.depth is not None:
        # A detected vehicle keeps its depth, which is none of the scene.
        return DepthMap(target.depth, (target.depth > 0) & target.valid_mask)
    return lift_pair(models.reconstructor, target, anchor).reference_depth


def compute_scale_drift(scales: Sequence[float]) -> float | None:
    """Compute max(ln s) - min(ln s) of the depth scales s; None for fewer than two."""
    return math.log(max(scales)) - math.log(min(scales)) if len(scales) > 1 else None


def attempt(compute: Callable[[], T]) -> T | str:
    """Return the result of `compute` or the reason of its failure; only OutputError is raised.

    Where outputs cannot be written, as on a full disk, no other task would succeed either.
    """
    try:
        return compute()
    except OutputError:
        raise
    except InputError as error:
        return str(error)
    except Exception as error:  # a defect of one task must not cost the others
        return f"{type(error).__name__}: {' '.join(str(error).split())}"
