"""Next-best target cameras: found, completed or only planned, and written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gscompleter.apps.commands.options import CompleteOptions, get_max_targets, parse_resolution
from gscompleter.apps.inputs.opening import Opened, Task, collect_usable_cameras
from gscompleter.apps.report.completion import Target
from gscompleter.completer import check_target_ids
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.errors import quote_value
from gscompleter.evaluation.metrics.coverage import (
    RenderPair,
    render_pairs,
    sample_held_out_cameras,
)
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
class Plan:
    """Targets and the estimated time of a completion."""

    task: Task
    holes: tuple[float, ...]
    """Hole fraction of each target, after completion of the previous ones."""
    seconds: float | None
    """Estimated seconds per target, or None if unknown."""
    context_seconds: float


def collect_cameras(options: CompleteOptions, opened: Opened, task: Task) -> dict[int, Camera]:
    """Return the cameras of all usable photographs by frame, in the frame of the result."""
    given = opened.photographs
    transform = task.frame @ compute_frame_from_photographs(-given.origin)
    known, device = task.views[0].camera, task.views[0].image.device
    cameras = collect_usable_cameras(given, range(len(given)), parse_resolution(options.resolution))
    moved = {f: transform_camera(camera, transform).to(device) for f, camera in cameras.items()}
    return {f: replace(c, near=known.near, far=known.far) for f, c in moved.items()}


def complete_targets(
    options: CompleteOptions, task: Task, cameras: Mapping[int, Camera], explorer: ViewPlanner
) -> tuple[Completion, Task]:
    """Complete the scene for the targets of `task`, or for targets that it finds."""
    completer = explorer.completer
    if task.targets:
        targets = [target.camera.to(task.views[0].image.device) for target in task.targets]
        return completer(task.views, targets, task.scene, task.check_views), task
    check_target_ids(task.scene, get_max_targets(options))
    begun = completer.begin(task.views, task.scene, task.check_views)
    completion, choices = explorer.explore(begun, list(cameras.values()), get_max_targets(options))
    return completion, replace(task, targets=make_targets(choices, list(cameras)))


def plan_completion(
    options: CompleteOptions, task: Task, cameras: Mapping[int, Camera], explorer: ViewPlanner
) -> Plan:
    """Plan the completion without running it."""
    begun = explorer.completer.begin(task.views, task.scene, task.check_views)
    if task.targets:
        targets = [target.camera.to(task.views[0].image.device) for target in task.targets]
        holes = explorer.compute_hole_fractions(begun, targets)
    else:
        choices = explorer.plan(begun, list(cameras.values()), get_max_targets(options))
        task = replace(task, targets=make_targets(choices, list(cameras)))
        holes = [choice.hole_fraction for choice in choices]
    return Plan(
        task, tuple(holes), estimate_target_seconds(options, begun), begun.seconds["context"]
    )


def estimate_target_seconds(options: CompleteOptions, begun: Completion) -> float | None:
    """Estimate the seconds per target from the context's, or return None if unknown."""
    if options.scene is not None or options.synthesis.name != "warp-inpaint":
        return None
    return LIFTED_VIEWS * begun.seconds["context"] / len(begun.views)


def print_plan(options: CompleteOptions, plan: Plan) -> None:
    """Print the targets, their holes and the estimated time."""
    table = Table("camera", "hole", box=None)
    for number, (target, hole) in enumerate(zip(plan.task.targets, plan.holes, strict=True)):
        table.add_row(
            f"{number + 1}: {name_target(target.frame, target.derived_from)}", f"{100 * hole:.1f} %"
        )
    console = Console(highlight=False)
    console.print(table)
    console.print(describe_plan(plan, options.out), soft_wrap=True)


def describe_plan(plan: Plan, out: Path) -> str:
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
    place = quote_value(out / TARGETS_FILE)
    return f"To complete: {counted}, {duration}. Edit the cameras in {place}."


def name_target(frame: int | None, near: int | None) -> str:
    """Name a target for tables."""
    if near is not None:
        return f"target near {near}"
    return "target" if frame is None else f"target {frame}"


def make_targets(choices: Iterable[Choice], frames: Sequence[int]) -> list[Target]:
    """Turn chosen candidates into targets."""
    return [Target(c.camera, derived_from=frames[c.candidate.base]) for c in choices]


def write_targets(folder: Path, task: Task) -> None:
    """Write the target cameras in the frame of the photographs, as `--target` reads them."""
    if not task.targets:
        return
    back = np.linalg.inv(task.frame)
    write_cameras(
        folder / TARGETS_FILE, [transform_camera_exactly(t.camera, back) for t in task.targets]
    )


def render_looks_around(
    options: CompleteOptions,
    completion: Completion,
    cameras: Iterable[Camera],
    explorer: ViewPlanner,
) -> list[RenderPair]:
    """Render the scene before and after at cameras around the photographs."""
    aside = sample_held_out_cameras(list(cameras), options.seed)
    return render_pairs(completion, aside, explorer.completer.renderer)
