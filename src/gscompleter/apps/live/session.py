"""Immutable sessions: every step returns a new session, and undo returns to the one before."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.apps.inputs.hole_kinds import read_marks
from gscompleter.apps.live.steps import (
    BoxNumbers,
    complete_at,
    fill_marked,
    remove_in_box,
    remove_marked,
    repair_marked,
)
from gscompleter.apps.viewer.exhibit import move_scene_camera
from gscompleter.completer import GSCompleter
from gscompleter.config import CompleterConfig
from gscompleter.data.photographs import Resolution
from gscompleter.data.scene import describe_camera, parse_camera
from gscompleter.splats.alignment.similarity import transform_camera_exactly
from gscompleter.splats.origin import format_corners
from gscompleter.stages.refusals import NOTHING_TO_COMPLETE
from gscompleter.state import Completion
from gscompleter.system.errors import InputError
from gscompleter.target_result import NOTHING_ADDED, TargetResult
from gscompleter.types import Camera

Action = Literal["complete", "fill", "remove", "repair"]
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
"""Rotation of a box that is not rotated, as a quaternion wxyz."""
ELSEWHERE = " “Find a hole” leads to one; what is wrong and not empty has to be painted over."
UNMARKED = "Nothing is marked; paint over what is meant."
NO_HOLE_MARKED = "The marks touch no hole."
NO_HOLE_LEFT = "That leaves no hole: what stands behind is shown."
NOTHING_MARKED = "The marks show no Gaussian; paint over what the picture shows."
EMPTY_BOX = "The box contains nothing; drag it, or make it larger."


@dataclass(frozen=True)
class SessionStep:
    """One thing that a person did: where the camera stood, and what was marked."""

    action: Action
    camera: Camera
    """In the frame of the photographs, as it is saved."""
    mask: bytes | None = None
    """PNG of the marks at the camera, white there; None without marks."""
    box: BoxNumbers | None = None
    """Smallest x, y and z, then largest, in the coordinates of the splat's file, of a box that is
    removed; None without one."""
    box_rotation: BoxNumbers = UPRIGHT
    """Rotation of the box about its centre, as a quaternion wxyz."""


@dataclass(frozen=True)
class Session:
    """A scene with all steps that are not undone."""

    completer: GSCompleter
    completions: tuple[Completion, ...]
    """The scene at first and after each step."""
    transform: Float[np.ndarray, "4 4"]
    """Similarity from the frame of the photographs to that of the result."""
    origin: Float[np.ndarray, "3"]
    """Local origin of the coordinates, in the frame of the photographs."""
    resolution: Resolution = None
    """Working size at which saved cameras are read; None for their own."""
    steps: tuple[SessionStep, ...] = ()
    """The steps, one for each completion but the first."""
    splat_origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Origin of the result in the coordinates of the splat's file; zero without one."""
    undone: tuple[tuple[Completion, SessionStep], ...] = field(default=(), compare=False)
    """Steps that were undone, with the scene after each; the last of them is done again first."""

    @property
    def latest(self) -> Completion:
        """The completion after the last step."""
        return self.completions[-1]

    @property
    def first_config(self) -> CompleterConfig:
        """The settings that the session began with; a removal leaves others, for its place."""
        return self.completions[0].config

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Camera of each target that was completed, in the frame of the photographs."""
        # A step that only removes has no target, and one that completed places of what was removed
        # and other holes has two.
        counts = [len(completion.targets) for completion in self.completions]
        return tuple(
            step.camera
            for step, before, after in zip(self.steps, counts, counts[1:], strict=False)
            for _ in range(after - before)
        )

    def extended(self, completion: Completion, step: SessionStep) -> Session:
        """Return the session after one more step; what was undone cannot be done again."""
        return replace(
            self,
            completions=(*self.completions, completion),
            steps=(*self.steps, step),
            undone=(),
        )


def save_camera(session: Session, camera: Camera) -> Camera:
    """Move a camera from the frame of the result to that of the photographs, in which it is saved.

    `place_saved_camera` is the inverse up to rounding, for a camera of the working size.
    """
    return transform_camera_exactly(camera, np.linalg.inv(session.transform))


def apply_step(session: Session, step: SessionStep) -> tuple[Session, str]:
    """Do one step, and describe it; the same session if nothing was changed.

    The camera is first read as from a file, so that the saved one gives the very same result.
    """
    check_step(step)
    start = time.perf_counter()
    camera = place_saved_camera(session, step.camera)
    completion, text = PERFORM[step.action](session, step, camera)
    seconds = time.perf_counter() - start
    if completion is session.latest:
        return session, text
    return session.extended(completion, step), f"Done in {seconds:.1f} s: {text}"


def check_step(step: SessionStep) -> None:
    """Refuse a box, its rotation or a mask that the action would ignore."""
    if step.box is not None and step.action != "remove":
        raise InputError(f"Only Remove takes a box, and {step.action} has one; leave it out.")
    if step.box is None and tuple(step.box_rotation) != UPRIGHT:
        raise InputError("A step without a box has a rotation of one; leave it out.")
    if step.mask is not None and (step.action == "complete" or step.box is not None):
        raise InputError("A step with a box, or that completes all holes, takes no mask.")


def complete_step(session: Session, step: SessionStep, camera: Camera) -> tuple[Completion, str]:
    """Complete all holes that the camera sees."""
    filled = complete_at(session.completer, session.first_config, session.latest, camera)
    text = describe_results(filled.results)
    if text.endswith(NOTHING_TO_COMPLETE):
        text += ELSEWHERE
    return filled.completion, text


def fill_step(session: Session, step: SessionStep, camera: Camera) -> tuple[Completion, str]:
    """Fill the holes that the marks touch."""
    marked = read_step_marks(step, camera)
    filled = fill_marked(session.completer, session.first_config, session.latest, camera, marked)
    return filled.completion, describe_results(filled.results) or NO_HOLE_MARKED


def remove_step(session: Session, step: SessionStep, camera: Camera) -> tuple[Completion, str]:
    """Remove what the box contains, or else what is marked."""
    completer = session.completer
    if step.box is None:
        marked = read_step_marks(step, camera)
        changed, count = remove_marked(completer, session.latest, camera, marked)
        if not count:
            return session.latest, NOTHING_MARKED
        return changed, f"{count:,} Gaussians are removed; fill their place, or undo."

    changed, count = remove_in_box(
        completer, session.latest, step.box, step.box_rotation, session.splat_origin
    )
    if not count:
        return session.latest, EMPTY_BOX
    corners = " ".join(format_corners(step.box[:3], step.box[3:]))
    rotation = " ".join(f"{number:.4g}" for number in step.box_rotation)
    return changed, (
        f"{count:,} Gaussians are removed; complete the hole, or undo.\n"
        f"As options of remove: --box {corners} --box-rotation {rotation}"
    )


def repair_step(session: Session, step: SessionStep, camera: Camera) -> tuple[Completion, str]:
    """Remove what is marked, and fill its place, but no hole that was there before."""
    marked = read_step_marks(step, camera)
    filled, count = repair_marked(
        session.completer, session.first_config, session.latest, camera, marked
    )
    if not count:
        return session.latest, NOTHING_MARKED
    completion = filled.completion
    if not any(result.has_changed_scene for result in filled.results):
        # The report tells why the place stays empty.
        completion = replace(completion, targets=(*completion.targets, *filled.results[-1:]))
    text = describe_results(filled.results) or NO_HOLE_LEFT
    return completion, f"{count:,} Gaussians are removed. {text}"


PERFORM: dict[Action, Callable[[Session, SessionStep, Camera], tuple[Completion, str]]] = {
    "complete": complete_step,
    "fill": fill_step,
    "remove": remove_step,
    "repair": repair_step,
}
"""Function of each action: the completion after it, and a sentence about what it did."""


def describe_results(results: Sequence[TargetResult]) -> str:
    """Describe what targets at one camera changed; empty for none.

    What was skipped is told only if nothing else was done.
    """
    told = [result for result in results if not result.skip_reason] or results[-1:]
    return "\n".join(map(describe_outcome, told))


def describe_outcome(result: TargetResult) -> str:
    """Describe what was added or recoloured at a camera: one sentence, then one line per note."""
    if not result.has_changed_scene:
        return "\n".join(result.notes or (NOTHING_ADDED,))
    changed = f"{len(result.added):,} Gaussians are added"
    if not len(result.added):
        changed = f"{result.num_recolored:,} Gaussians are recoloured"
    text = f"{changed} in a hole of {100 * result.hole_fraction:.1f} % of the image."
    return "\n".join((text, *result.notes))


def place_saved_camera(session: Session, saved: Camera) -> Camera:
    """Move a saved camera to the frame of the result, as `--target` reads it from a file."""
    described = describe_camera(saved)
    read = parse_camera(described, "the camera", session.resolution, session.origin.tolist())
    camera = move_scene_camera(read, session.transform, session.origin)
    return camera.to(session.latest.views[0].image.device)


def read_step_marks(step: SessionStep, camera: Camera) -> Bool[Tensor, "h w"]:
    """Read the marks of a step at the size of its camera."""
    if step.mask is None:
        raise InputError(UNMARKED)
    return read_marks(step.mask, camera, name="The mask")


def undo_step(session: Session) -> Session:
    """Take the last step back."""
    earlier = session.completions[:-1]
    if not earlier:
        raise InputError("There is nothing to undo; complete or repair something first.")
    last = (session.latest, session.steps[-1])
    return replace(
        session, completions=earlier, steps=session.steps[:-1], undone=(*session.undone, last)
    )


def redo_step(session: Session) -> Session:
    """Do the last step that was undone again."""
    if not session.undone:
        raise InputError("There is nothing to redo; undo something first.")
    completion, step = session.undone[-1]
    return replace(session.extended(completion, step), undone=session.undone[:-1])
