"""Target cameras: found if none are named, completed or only planned, and written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gscompleter.apps.commands.options import CompleteOptions, get_max_targets, parse_resolution
from gscompleter.apps.inputs.opening import Opened, Task
from gscompleter.apps.inputs.selection import collect_usable_cameras
from gscompleter.apps.report.completion import Target
from gscompleter.completer import GSCompleter, check_target_ids
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.errors import quote_value
from gscompleter.io.files import TARGETS_FILE
from gscompleter.next_best_view.gain import Choice
from gscompleter.next_best_view.planner import ViewPlanner
from gscompleter.splat_alignment.similarity import transform_camera, transform_camera_exactly
from gscompleter.state import Completion
from gscompleter.types import Camera

LIFTED_VIEWS = 3
"""Time to complete a target, relative to the reconstruction of one photograph. Measured: 1.8 to 3.3
(docs/performance.md)."""


@dataclass(frozen=True)
class Prepared:
    """Everything that is loaded before the first completion."""

    options: CompleteOptions
    opened: Opened
    task: Task
    explorer: ViewPlanner
    cameras: Mapping[int, Camera]
    """Cameras of all usable photographs by frame, in the frame of the result."""
    seconds: Mapping[str, float]
    """Wall time by stage so far."""

    @property
    def completer(self) -> GSCompleter:
        """The completer with its models."""
        return self.explorer.completer

    def begin(self) -> Completion:
        """Initialize the context."""
        return self.completer.begin(self.task.views, self.task.scene, self.task.check_views)

    def with_choices(self, choices: Iterable[Choice]) -> Prepared:
        """Return a copy with chosen candidates as targets."""
        frames = list(self.cameras)
        targets = [Target(c.camera, derived_from=frames[c.candidate.base]) for c in choices]
        return replace(self, task=replace(self.task, targets=targets))


@dataclass(frozen=True)
class Plan:
    """Targets and the time of a completion."""

    task: Task
    holes: Sequence[float]
    """Hole fraction of each target, after completion of the previous ones."""
    context_seconds: float


def collect_cameras(options: CompleteOptions, opened: Opened, task: Task) -> dict[int, Camera]:
    """Return the cameras of all usable photographs by frame, in the frame of the result."""
    given = opened.photographs
    transform = task.frame @ compute_frame_from_photographs(-given.origin)
    known = task.views[0].camera
    cameras = collect_usable_cameras(given, range(len(given)), parse_resolution(options.resolution))
    return {
        frame: replace(
            transform_camera(camera, transform).to(task.device), near=known.near, far=known.far
        )
        for frame, camera in cameras.items()
    }


def complete_targets(ready: Prepared) -> tuple[Completion, Prepared]:
    """Complete the scene for the named targets, or for targets that it finds."""
    task, count = ready.task, get_max_targets(ready.options)
    if task.targets:
        named = ready.completer(task.views, task.target_cameras, task.scene, task.check_views)
        return named, ready
    check_target_ids(task.scene, count)
    cameras = list(ready.cameras.values())
    completion, choices = ready.explorer.explore(ready.begin(), cameras, count)
    return completion, ready.with_choices(choices)


def plan_completion(ready: Prepared) -> Plan:
    """Plan the completion without running it."""
    begun = ready.begin()
    context_seconds = begun.seconds["context"]
    if ready.task.targets:
        holes = ready.explorer.compute_hole_fractions(begun, ready.task.target_cameras)
        return Plan(ready.task, holes, context_seconds)
    cameras = list(ready.cameras.values())
    choices = ready.explorer.plan(begun, cameras, get_max_targets(ready.options))
    holes = [choice.hole_fraction for choice in choices]
    return Plan(ready.with_choices(choices).task, holes, context_seconds)


def print_plan(options: CompleteOptions, plan: Plan) -> None:
    """Print the targets, their holes and the estimated time."""
    table = Table("camera", "hole", box=None)
    for number, (target, hole) in enumerate(zip(plan.task.targets, plan.holes, strict=True), 1):
        name = name_target(target.frame, target.derived_from)
        table.add_row(f"{number}: {name}", f"{100 * hole:.1f} %")
    console = Console(highlight=False)
    console.print(table)
    console.print(describe_plan(options, plan), soft_wrap=True)


def describe_plan(options: CompleteOptions, plan: Plan) -> str:
    """Write the sentence on the number of targets and the estimated time."""
    number = len(plan.holes)
    if number == 0:
        return "No camera has much to gain; there is nothing to complete."
    duration = "in a time that is not known in advance"
    if options.scene is None and options.synthesis.name == "warp-inpaint":
        spent = plan.context_seconds
        seconds = number * LIFTED_VIEWS * spent / len(plan.task.views)
        duration = f"in about {seconds:.0f} s after the context ({spent:.0f} s)"
    counted = "1 camera" if number == 1 else f"{number} cameras"
    place = quote_value(options.out / TARGETS_FILE)
    return f"To complete: {counted}, {duration}. Edit the cameras in {place}."


def name_target(frame: int | None, near: int | None) -> str:
    """Name a target for tables."""
    if near is not None:
        return f"target near {near}"
    return "target" if frame is None else f"target {frame}"


def write_targets(folder: Path, task: Task) -> None:
    """Write the target cameras in the frame of the photographs, as `--target` reads them."""
    if task.targets:
        back = np.linalg.inv(task.frame)
        cameras = [transform_camera_exactly(target.camera, back) for target in task.targets]
        write_cameras(folder / TARGETS_FILE, cameras)
