"""Lines on what was opened and what is to be done."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from gscompleter.apps.inputs.memory import estimate_memory
from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.data.photograph_names import name_photograph
from gscompleter.data.photographs import Photographs
from gscompleter.numerics.image_ops import compute_mask_fraction
from gscompleter.splats.formats import describe_oddities
from gscompleter.system.errors import join_names, quote_value
from gscompleter.system.memory import format_whole_gigabytes, read_memory_bytes

MAX_LISTED_PHOTOGRAPHS = 8
"""Most photographs that a line names."""
MAX_PHRASE = 120
"""Longest phrase of the line, in characters."""


def describe_task(
    opened: Opened,
    task: CompletionTask,
    max_targets: int,
    models: str,
    out: Path,
    doing: str = "complete the scene",
) -> list[str]:
    """Write the four lines; the cameras of `task` have the working depth range.

    `max_targets` is the number of targets to search for if the task has none; 0 for what
    photographs show alone. `models` names Ψ and Φ, `doing` what is done with the scene.
    """
    files = opened.files
    context = [name_photograph(frame, files.get(frame)) for frame in task.context_frames]
    images = "photographs" if opened.renders_from is None else "renders"
    goal = f"{doing} from {images} {join_names(context, MAX_LISTED_PHOTOGRAPHS)}"
    if task.scene is None and task.check_views:
        goal += f", fitted to {len(task.check_views)} more,"
    targets = join_names(
        [opened.name_target(target) for target in task.targets], MAX_LISTED_PHOTOGRAPHS
    )
    if targets:
        goal += f" for {targets}"
    elif max_targets == 1:
        goal += " for a camera that is found"
    elif max_targets > 1:
        goal += f" for up to {max_targets} cameras that are found"
    else:
        named = join_names(context, MAX_LISTED_PHOTOGRAPHS)
        goal = f"add what photographs {named} show and the splat lacks"

    # On a GPU the splat is in its memory, not in that of the machine.
    needed = estimate_memory(task, task.scene if task.device.type == "cpu" else None)
    available = read_memory_bytes()
    of = "" if available is None else f" of {format_whole_gigabytes(available)}"
    return [
        *describe_opening(opened, task),
        f"To do: {goal} by {models} on {task.device.type}, written to {quote_value(out)}.",
        f"Memory: up to {format_whole_gigabytes(needed)}{of}.",
    ]


def describe_opening(opened: Opened, task: CompletionTask) -> list[str]:
    """Write the lines on the opened scene."""
    scene = task.scene
    camera = task.views[0].camera
    photographs = opened.photographs
    used = len(photographs.posed) - len(list_missing_photographs(photographs))
    splat = ""
    if scene is not None:
        mode = "antialiased " if scene.is_antialiased else ""
        assert task.splat_file is not None
        name = quote_value(task.splat_file.path)
        splat = f"; {name}, {len(scene):,} {mode}Gaussians of SH degree {scene.sh_degree}"
    source = f"{quote_value(opened.request.folder)}, {opened.format}, {used} of "
    source += f"{opened.num_photographs} photographs{splat}"
    if opened.renders_from is not None:
        source = f"{splat.removeprefix('; ')}; no photographs"
    if photographs.unused:
        source += (
            f"; not used: {join_names(photographs.unused, MAX_LISTED_PHOTOGRAPHS, MAX_PHRASE)}"
        )
    return [
        f"Opened: {source}.",
        f"Found: {task.frame_description.rstrip('.')}; depths from {camera.near:.3g} to "
        f"{camera.far:.3g}; worked at {camera.width} x {camera.height} (--resolution changes it).",
        *describe_missing_photographs(photographs),
        *describe_masks(photographs, task),
        *([] if task.splat_file is None else describe_oddities(task.splat_file.path)),
        *task.depth_notes,
    ]


def list_missing_photographs(photographs: Photographs) -> list[str]:
    """List the names of photographs that cameras name and that are not there."""
    posed = [photographs.frame(number) for number in photographs.posed]
    named = [frame for frame in posed if frame.image is not None]
    return [frame.name for frame in named if not frame.has_photograph()]


def describe_missing_photographs(photographs: Photographs) -> list[str]:
    """Say which cameras have no photograph; such a camera stays, because it can be a target."""
    missing = list_missing_photographs(photographs)
    if not missing:
        return []
    return [
        f"{len(missing)} of {len(photographs)} photographs are missing, and their cameras can only "
        f"be targets: {join_names(missing, MAX_LISTED_PHOTOGRAPHS)}."
    ]


def describe_masks(photographs: Photographs, task: CompletionTask) -> list[str]:
    """Say which masks were found for the photographs of a task, and how much they hide."""
    # Cameras from elsewhere have no frame, and no mask.
    frames = [frame for frame in task.used_frames if frame is not None]
    masks = photographs.describe_masks(sorted(frames))
    if masks is None:
        return []
    most = max(compute_mask_fraction(view.ignore_mask) for view in task.views)
    if most == 0:
        return [f"Masks: {masks}; they hide nothing of the photographs in use."]
    return [
        f"Masks: {masks}; what they hide, up to {100 * most:.1f} % of a photograph, is neither "
        "reconstructed nor scored (--no-masks uses it)."
    ]


def print_lines(console: Console, *lines: str) -> None:
    """Print lines without markup."""
    for line in lines:
        console.print(line, soft_wrap=True)
