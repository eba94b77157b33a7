"""Lines on what was opened and what is to be done."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from gscompleter.apps.inputs.memory import estimate_memory
from gscompleter.apps.inputs.task import CompletionTask, Opened, Target
from gscompleter.data.frame import Frame
from gscompleter.data.photograph_names import name_photograph
from gscompleter.data.photographs import Photographs
from gscompleter.numerics.image_ops import compute_mask_fraction
from gscompleter.splats.formats import describe_oddities
from gscompleter.system.errors import format_rounded, join_names, quote_value
from gscompleter.system.memory import format_whole_gigabytes, read_memory_bytes
from gscompleter.types import View

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
    """Write the lines on the opened scene, on what is to be done, and on the memory it needs.

    The cameras of `task` have the working depth range. `max_targets` is the number of targets to
    search for if the task has none; 0 for what photographs show alone. `models` names Ψ and Φ,
    `doing` what is done with the scene.
    """
    # On a GPU the splat is in its memory, not in that of the machine.
    needed = estimate_memory(task, task.scene if task.device.type == "cpu" else None)
    available = read_memory_bytes()
    of = "" if available is None else f" of {format_whole_gigabytes(available)}"
    goal = describe_goal(opened, task, max_targets, doing)
    return [
        *describe_opening(opened, task),
        f"To do: {goal} by {models} on {task.device.type}, written to {quote_value(out)}.",
        f"Memory: up to {format_whole_gigabytes(needed)}{of}.",
    ]


def describe_goal(opened: Opened, task: CompletionTask, max_targets: int, doing: str) -> str:
    """Describe in a clause what is done; the arguments are those of `describe_task`."""
    files = opened.files
    names = [name_photograph(frame, files.get(frame)) for frame in task.context_frames]
    context = join_names(names, MAX_LISTED_PHOTOGRAPHS)
    targets = [opened.name_target(target) for target in task.targets]
    if targets:
        place = join_names(targets, MAX_LISTED_PHOTOGRAPHS)
    elif max_targets == 0:
        return f"add what photographs {context} show and the splat lacks"
    elif max_targets == 1:
        place = "a camera that is found"
    else:
        place = f"up to {max_targets} cameras that are found"

    images = "photographs" if opened.renders_from is None else "renders"
    fitted = ""
    if task.scene is None and task.check_views:
        fitted = f", fitted to {len(task.check_views)} more,"
    return f"{doing} from {images} {context}{fitted} for {place}"


def describe_opening(opened: Opened, task: CompletionTask) -> list[str]:
    """Write the lines on the opened scene."""
    camera = task.views[0].camera
    # Set when the scene was opened.
    assert camera.near is not None
    assert camera.far is not None
    photographs = opened.photographs
    unused = ""
    if photographs.unused:
        unused = join_names(photographs.unused, MAX_LISTED_PHOTOGRAPHS, MAX_PHRASE)
        unused = f"; not used: {unused}"
    return [
        f"Opened: {describe_opened(opened, task)}{unused}.",
        f"Found: {task.frame_description.rstrip('.')}; depths from "
        f"{format_rounded(camera.near)} to {format_rounded(camera.far)}; worked at {camera.width} "
        f"x {camera.height} (--resolution changes it).",
        *describe_missing_photographs(photographs),
        *describe_masks(photographs, task),
        *([] if task.splat_file is None else describe_oddities(task.splat_file.path)),
        *task.depth_notes,
    ]


def describe_opened(opened: Opened, task: CompletionTask) -> str:
    """Describe in a clause the photographs and the splat that were opened."""
    scene = task.scene
    splat = ""
    if scene is not None:
        mode = "antialiased " if scene.is_antialiased else ""
        assert task.splat_file is not None
        name = quote_value(task.splat_file.path)
        splat = f"{name}, {len(scene):,} {mode}Gaussians of SH degree {scene.sh_degree}"
    if opened.renders_from is not None:
        return f"{splat}; no photographs"

    photographs = opened.photographs
    num_bare = len(photographs) - len(list_named(photographs))
    counted = f"{len(photographs.present)} of {opened.num_photographs - num_bare} photographs"
    if num_bare:
        counted += f", cameras without one: {num_bare}"
    source = f"{quote_value(opened.request.folder)}, {opened.format}, {counted}"
    return f"{source}; {splat}" if splat else source


def list_named(photographs: Photographs) -> list[Frame]:
    """List the frames that name a photograph; the others are cameras alone."""
    return [frame for frame in photographs.frames if frame.image is not None]


def list_missing_photographs(photographs: Photographs) -> list[str]:
    """List the names of photographs that cameras name and that are not there."""
    named = [frame for frame in list_named(photographs) if frame.has_camera]
    return [frame.name for frame in named if not frame.has_photograph()]


def describe_missing_photographs(photographs: Photographs) -> list[str]:
    """Say which cameras have no photograph; such a camera stays, because it can be a target."""
    missing = list_missing_photographs(photographs)
    if not missing:
        return []
    return [
        f"{len(missing)} of {len(list_named(photographs))} photographs are missing, and their "
        f"cameras can only be targets: {join_names(missing, MAX_LISTED_PHOTOGRAPHS)}."
    ]


def describe_masks(photographs: Photographs, task: CompletionTask) -> list[str]:
    """Say which masks were found for the photographs of a task, and how much they hide."""
    # Cameras from elsewhere have no frame, and no mask.
    frames = [frame for frame in task.used_frames if frame is not None]
    masks = photographs.describe_masks(sorted(frames))
    if masks is None:
        return []
    # A mask may be that of a target, or of a photograph that checks the scene.
    used: list[View | Target] = [*task.views, *(task.check_views or ()), *task.targets]
    most = max(compute_mask_fraction(one.ignore_mask) for one in used)
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
