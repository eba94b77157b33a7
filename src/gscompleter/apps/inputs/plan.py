"""Summary of the input, printed before the work in four lines."""

from __future__ import annotations

from gscompleter.apps.commands.options import CompleteOptions, SceneOptions, get_max_targets
from gscompleter.apps.inputs.opening import Opened, Task, estimate_memory
from gscompleter.apps.report.completion import Target
from gscompleter.errors import join_names, quote_value
from gscompleter.memory import format_whole_gigabytes, read_memory_bytes

MAX_NAMED = 8
"""Most frames or targets that a line names."""


def describe_task(options: CompleteOptions, opened: Opened, task: Task) -> list[str]:
    """Write the four lines; the cameras of `task` have the working depth range."""
    targets = join_names([name_target(target) for target in task.targets], MAX_NAMED)
    found = f"up to {get_max_targets(options)} cameras that are found"
    models = f"{options.reconstructor} and {options.synthesis.generator} on {task.device.type}"
    needed = estimate_memory(task, task.scene if task.device.type == "cpu" else None)
    available = read_memory_bytes()
    of = "" if available is None else f" of {format_whole_gigabytes(available)}"
    return [
        *describe_opening(options, opened, task),
        f"To do: complete the scene from frames {join_names(task.context_frames, MAX_NAMED)} for "
        f"{targets or found} by {models}, written to {quote_value(options.out)}.",
        f"Memory: up to {format_whole_gigabytes(needed)}{of}.",
    ]


def describe_opening(options: SceneOptions, opened: Opened, task: Task) -> list[str]:
    """Write the lines on the opened scene."""
    scene, camera, used = task.scene, task.views[0].camera, len(opened.photographs)
    splat = ""
    if scene is not None:
        mode = "antialiased " if scene.is_antialiased else ""
        name = quote_value(options.scene)
        splat = f"; {name}, {len(scene):,} {mode}Gaussians of SH degree {scene.sh_degree}"
    return [
        f"Opened: {quote_value(options.folder)}, {opened.format}, {used} of "
        f"{opened.num_photographs} photographs{splat}.",
        f"Found: {task.frame_description.rstrip('.')}; depths from {camera.near:.3g} to "
        f"{camera.far:.3g}; worked at {camera.width} x {camera.height} (--resolution changes it).",
    ]


def name_target(target: Target) -> str:
    """Name a target for lines and tables."""
    if target.derived_from is not None:
        return f"target near {target.derived_from}"
    return "a given camera" if target.frame is None else f"target {target.frame}"
