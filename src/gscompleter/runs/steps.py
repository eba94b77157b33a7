"""A method on a task: target after target, each time into the scene as it stands by then.

A step is what the method does with any target. Once it is done, the photograph of its target is
known: whatever the method, later steps may choose it for their anchor. The paper gives the true
image to the generator as well (our generator `oracle`), which leaves nothing but registration to
compare.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from jaxtyping import Bool
from torch import Tensor

from gscompleter.errors import InputError, OutputError
from gscompleter.metrics.scores import MIN_PIXELS, Drawings, Scores, Truth, counted_psnr, score
from gscompleter.render import Renderer
from gscompleter.runs.memory import peak_memory
from gscompleter.runs.methods import METHODS, Models, Prediction, numbered
from gscompleter.runs.store import (
    load_prediction,
    save_image,
    save_prediction,
    step_path,
    truth_path,
)
from gscompleter.stages.anchor import lift
from gscompleter.types import Camera, Completion, DepthMap, Gaussians, InitialContext, View

T = TypeVar("T")


@dataclass(frozen=True)
class Prepared:
    """All about a task that its methods share. The cameras have the depth range of the scene."""

    context: Gaussians
    """What Ψ makes of the views."""
    views: tuple[View, ...]
    """The photographs that are known from the beginning."""
    targets: tuple[View, ...]
    """Photographs to complete the scene for, in this order, up to the first that is damaged."""
    neighbours: tuple[View, ...]
    """Photographs beside the target, for scoring only."""
    models: Models
    seconds: float
    """What Ψ took."""
    error: str | None = None
    """Why there are no more targets; None where all can be read."""


@dataclass(frozen=True)
class Step:
    """What a method did for one target."""

    frame: int
    """The target."""
    anchor: int | None
    """Frame that made the stereo pair with it; None for a method that lifts nothing."""
    anchor_fallback: bool
    """True where every view was turned too far and the least-turned one was taken."""
    scores: Scores
    """Of the scene just before the step and just after it."""
    psnr_end: float | None
    """PSNR at the target, in dB, of the scene that the whole task leaves: below that just after
    the step where later ones spoiled it. None while the task goes on."""
    depth_scale: float | None
    """See `depth_scale`; None in a task of one step, and where too little was added to tell."""
    added: int
    """Gaussians by which the scene grew."""
    gaussians: int
    """Gaussians of the scene after it."""
    notes: tuple[str, ...]
    """Fallbacks that were taken, a sentence each."""
    seconds: dict[str, float]
    """Wall time by stage, and `total`."""
    peak_bytes: int | None
    """The most memory that was held; None where the system does not tell."""


@dataclass(frozen=True)
class Progress:
    """A task as far as a method came."""

    scene: Gaussians
    """The context and what was made of it."""
    views: tuple[View, ...]
    """The photographs that are known by now."""
    steps: tuple[Step, ...] = ()
    error: str | None = None
    """Why it went no further; None where nothing failed."""


def complete_task(task: Prepared, method: str, folder: Path) -> Progress:
    """Complete a scene for one target after the other; a step that fails is the last.

    Args:
        task: The scene and its targets.
        method: Name of a method.
        folder: Of the task, where each step is saved and, where it is there already, read back.

    Raises:
        OutputError: where a step cannot be saved.
    """
    progress = Progress(task.context, task.views, error=task.error)
    for target in task.targets:
        following = attempt(partial(advanced, progress, target, task, method, folder))
        if isinstance(following, str):
            progress = replace(progress, error=f"Frame {target.frame}: {following}")
            break
        progress = following
    return ended(progress, task.targets, task.models.renderer)


def advanced(
    progress: Progress, target: View, task: Prepared, method: str, folder: Path
) -> Progress:
    """`progress` after the step at `target`."""
    number = len(progress.steps) + 1
    state = task.models.completer().begin_with(InitialContext(progress.scene, progress.views))
    path = step_path(folder, method, number)
    prediction = predicted(method, state, target.camera, number, task.models, path)
    step, seen = step_of(prediction, state, target, task)
    save_image(path.with_suffix(".png"), seen.after.image)
    save_image(path.with_name(f"before-{number:03d}.png"), seen.before.image)
    save_image(truth_path(folder, number), target.image)
    return replace(
        progress,
        scene=prediction.scene,
        views=(*progress.views, target),
        steps=(*progress.steps, step),
    )


def predicted(
    method: str, state: Completion, target: Camera, number: int, models: Models, path: Path
) -> Prediction:
    """What is saved at `path`, else what `method` makes of the step, as by `kept`."""

    def save() -> None:
        with peak_memory(state.scene.means.device) as peak:
            made = METHODS[method](state, target, models)
        made = numbered(made, number, state.scene)
        save_prediction(path, replace(made, peak_bytes=peak.bytes))

    return kept(path, lambda: load_prediction(path, state.scene), save)


def kept(path: Path, load: Callable[[], T | None], save: Callable[[], None]) -> T:
    """What `load` finds at `path`, where `save` computes and writes it first if need be.

    It is read back in any case, so that a run that was stopped goes on with the very same tensors.

    Raises:
        OutputError: where it cannot be saved.
    """
    found = load()
    if found is None:
        save()
        found = load()
    if found is None:
        raise OutputError(f"{path} cannot be read back; look whether the disk is sound.")
    return found


def step_of(
    prediction: Prediction, state: Completion, target: View, task: Prepared
) -> tuple[Step, Drawings]:
    """What a step came to, and what its camera sees."""
    truth = Truth(state.views, target, task.neighbours)
    before, after = state.scene, prediction.scene
    scores, seen = score(
        before, after, prediction.added, truth, task.models.renderer, prediction.registered
    )
    anchor = None if prediction.anchor is None else state.views[prediction.anchor]
    scale = None
    if len(task.targets) > 1 and anchor is not None and prediction.added is not None:
        expected = metric_depth(target, anchor, task.models)
        scale = depth_scale(
            prediction.added, seen.holes, target.camera, expected, task.models.renderer
        )
    step = Step(
        frame=number_of(target),
        anchor=None if anchor is None else number_of(anchor),
        anchor_fallback=prediction.anchor_fallback,
        scores=scores,
        psnr_end=None,
        depth_scale=scale,
        added=len(after) - len(before),
        gaussians=len(after),
        notes=prediction.notes,
        seconds=dict(prediction.seconds),
        peak_bytes=prediction.peak_bytes,
    )
    json.dumps(asdict(step), allow_nan=False)
    return step, seen


def number_of(view: View) -> int:
    """The number of a frame of a clip."""
    assert view.frame is not None
    return view.frame


def metric_depth(target: View, anchor: View, models: Models) -> DepthMap:
    """The measured depth of `target` where the data has it, in scene units.

    Elsewhere it is what Ψ says of the two photographs, before any registration, valid where the
    model measured it.
    """
    if target.depth is not None:
        return DepthMap(target.depth, target.depth > 0)
    return lift(models.reconstructor, target, anchor).reference_depth


def depth_scale(
    added: Gaussians,
    holes: Bool[Tensor, "h w"],
    target: Camera,
    expected: DepthMap,
    renderer: Renderer,
) -> float | None:
    """How far away what was added stands, as a multiple of how far it should: 1 is metric.

    The median of D_added / D_expected over the pixels of `holes` where both are known, with
    D_added the z-depth of `added`, drawn alone, where it covers at least half of the pixel. Only
    the holes of the scene as it was count, because a method that adds there alone and one that
    covers the whole image are to be compared. None of fewer than `MIN_PIXELS`.
    """
    alone = renderer.render(added, target).depth_map()
    both = holes & alone.valid & expected.valid
    if both.sum() < MIN_PIXELS:
        return None
    return (alone.depth / expected.depth)[both].median().item()


def scale_drift(scales: Sequence[float]) -> float | None:
    """How much the depth scale s varies over a sequence: max(ln s) - min(ln s).

    0.1 means that its largest is 10 % above its smallest. None of fewer than two.
    """
    return math.log(max(scales)) - math.log(min(scales)) if len(scales) > 1 else None


def ended(progress: Progress, targets: Sequence[View], renderer: Renderer) -> Progress:
    """`progress`, each of its steps with the PSNR that the last scene has there."""
    steps = []
    for step, target in zip(progress.steps, targets, strict=False):  # the last may have failed
        image = renderer.render(progress.scene, target.camera).image
        steps.append(replace(step, psnr_end=counted_psnr(image, target)))
    return replace(progress, steps=tuple(steps))


def attempt(compute: Callable[[], T]) -> T | str:
    """What `compute` returns, or why it failed, in one line.

    Raises:
        OutputError: where a result could not be written, which no other task could either.
    """
    try:
        return compute()
    except OutputError:
        raise
    except InputError as error:
        return str(error)
    except Exception as error:  # a defect of one task must not cost the others
        return f"{type(error).__name__}: {' '.join(str(error).split())}"
