"""Next-best target cameras: found, completed or only planned, and written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gscompleter.commands.opening import Opened, Task, usable_cameras
from gscompleter.commands.options import CompleteOptions, most, working_size
from gscompleter.completer import check_numbers
from gscompleter.data.origin import frame_from_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.errors import quoted
from gscompleter.explorer import Explorer
from gscompleter.frames.similarity import moved_camera, moved_exactly
from gscompleter.io.files import TARGETS
from gscompleter.metrics.coverage import Look, held_out_cameras, looks_of
from gscompleter.reports.completion import Target
from gscompleter.stages.exploration import Choice
from gscompleter.types import Camera, Completion

LIFTED_VIEWS = 3
"""Time to complete a target, relative to the reconstruction of one photograph. Measured: 1.8 to 3.3
(docs/performance.md)."""


@dataclass(frozen=True)
class Plan:
    """Targets and the estimated time of a completion."""

    task: Task
    holes: tuple[float, ...]
    """Hole fraction of each target, after completion of the previous ones."""
    seconds: float | None
    """Estimated seconds per target, or None if unknown."""
    context_seconds: float


def cameras_of(options: CompleteOptions, opened: Opened, task: Task) -> dict[int, Camera]:
    """Return the cameras of all usable photographs by frame, in the frame of the result."""
    given = opened.photographs
    transform = task.frame @ frame_from_photographs(-given.origin)
    known, device = task.views[0].camera, task.views[0].image.device
    cameras = usable_cameras(given, range(len(given)), working_size(options.resolution))
    moved = {f: moved_camera(camera, transform).to(device) for f, camera in cameras.items()}
    return {f: replace(c, near=known.near, far=known.far) for f, c in moved.items()}


def completed(
    options: CompleteOptions, task: Task, cameras: Mapping[int, Camera], explorer: Explorer
) -> tuple[Completion, Task]:
    """Complete the scene for the targets of `task`, or for targets that it finds."""
    completer = explorer.completer
    if task.targets:
        targets = [target.camera.to(task.views[0].image.device) for target in task.targets]
        return completer(task.views, targets, task.scene, task.witnesses), task
    check_numbers(task.scene, most(options))
    begun = completer.begin(task.views, task.scene, task.witnesses)
    completion, choices = explorer.explore(begun, list(cameras.values()), most(options))
    return completion, replace(task, targets=targets_of(choices, list(cameras)))


def planned(
    options: CompleteOptions, task: Task, cameras: Mapping[int, Camera], explorer: Explorer
) -> Plan:
    """Plan the completion without running it."""
    begun = explorer.completer.begin(task.views, task.scene, task.witnesses)
    if task.targets:
        targets = [target.camera.to(task.views[0].image.device) for target in task.targets]
        holes = explorer.holes(begun, targets)
    else:
        choices = explorer.plan(begun, list(cameras.values()), most(options))
        task = replace(task, targets=targets_of(choices, list(cameras)))
        holes = [choice.hole for choice in choices]
    return Plan(task, tuple(holes), seconds_of(options, begun), begun.seconds["context"])


def seconds_of(options: CompleteOptions, begun: Completion) -> float | None:
    """Estimate the seconds per target from the context's, or return None if unknown."""
    if options.scene is not None or options.synthesis.name != "warp-inpaint":
        return None
    return LIFTED_VIEWS * begun.seconds["context"] / len(begun.views)


def tell_plan(options: CompleteOptions, plan: Plan) -> None:
    """Print the targets, their holes and the estimated time."""
    table = Table("camera", "hole", box=None)
    for number, (target, hole) in enumerate(zip(plan.task.targets, plan.holes, strict=True)):
        table.add_row(f"{number + 1}: {name_of(target.frame, target.near)}", f"{100 * hole:.1f} %")
    console = Console(highlight=False)
    console.print(table)
    console.print(sentence_of(plan, options.out), soft_wrap=True)


def sentence_of(plan: Plan, out: Path) -> str:
    """Write the sentence on the number of targets and the estimated time."""
    number = len(plan.holes)
    if number == 0:
        return "No camera has much to gain; there is nothing to complete."
    duration = "in a time that is not known in advance"
    if plan.seconds is not None:
        duration = (
            f"in about {plan.seconds * number:.0f} s after the context "
            f"({plan.context_seconds:.0f} s)"
        )
    counted = "1 camera" if number == 1 else f"{number} cameras"
    return f"To complete: {counted}, {duration}. Edit the cameras in {quoted(out / TARGETS)}."


def name_of(frame: int | None, near: int | None) -> str:
    """Name a target for tables."""
    if near is not None:
        return f"target near {near}"
    return "target" if frame is None else f"target {frame}"


def targets_of(choices: Iterable[Choice], frames: Sequence[int]) -> list[Target]:
    """Turn chosen candidates into targets."""
    return [Target(c.camera, near=frames[c.candidate.base]) for c in choices]


def write_targets(folder: Path, task: Task) -> None:
    """Write the target cameras in the frame of the photographs, as `--target` reads them."""
    if not task.targets:
        return
    back = np.linalg.inv(task.frame)
    write_cameras(folder / TARGETS, [moved_exactly(t.camera, back) for t in task.targets])


def looks_around(
    options: CompleteOptions, completion: Completion, cameras: Iterable[Camera], explorer: Explorer
) -> list[Look]:
    """Render the scene before and after at cameras around the photographs."""
    aside = held_out_cameras(list(cameras), options.seed)
    return looks_of(completion, aside, explorer.completer.renderer)
