"""Summary of the input, printed before the work in four lines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gscompleter.apps.commands.options import CompleteOptions, SceneOptions, get_max_targets
from gscompleter.apps.inputs.opening import Opened, Task, estimate_splat_bytes
from gscompleter.data.formats import FORMATS
from gscompleter.data.frame import Frame
from gscompleter.errors import join_names, quote_value
from gscompleter.memory import estimate_bytes, format_whole_gigabytes, read_memory_bytes
from gscompleter.types import Camera, Gaussians

SOURCE_NAMES = {
    "given": "as given",
    "scene": "as the scene says",
    "points": "by the sparse points",
    "splat": "by the splat",
    "features": "by matched features",
}
MAX_NAMED = 8


def describe_task(options: CompleteOptions, opened: Opened, task: Task) -> list[str]:
    """Write the four lines; the cameras of `task` have the working depth range."""
    return [
        *describe_opening(options, opened, task),
        f"To do: {describe_work(options, task)}.",
        f"Budget: {task.context_note}, {describe_memory(options, task)}.",
    ]


def describe_opening(options: SceneOptions, opened: Opened, task: Task) -> list[str]:
    """Write the lines on the opened scene."""
    splat = ""
    if task.scene is not None and options.scene is not None:
        splat = f"; {describe_splat(options.scene, task.scene)}"
    return [
        f"Opened: {quote_value(options.folder)}, {describe_photographs(opened)}{splat}.",
        f"Found: {describe_found(options, opened, task)}.",
    ]


def describe_photographs(opened: Opened) -> str:
    """Describe the format, photographs, cameras and points of a scene."""
    given = opened.photographs
    count = f"{opened.num_photographs} photographs"
    if opened.num_photographs != len(given):
        count = f"{len(given)} of {count}"
    points = given.points()
    num_points = "no points" if points is None else f"{len(points):,} points"
    name = "photographs without cameras" if opened.format == "photographs" else opened.format
    return f"{name}, {count}, {describe_lenses(given.frames)}, {num_points}"


def describe_lenses(frames: Sequence[Frame]) -> str:
    """Describe the cameras and lenses."""
    cameras = dict.fromkeys(frame.intrinsics for frame in frames)
    lenses = dict.fromkeys(c.distortion.projection for c in cameras if c.distortion)
    lens = f"{' and '.join(lenses)} lens distortion removed" if lenses else "no lens distortion"
    return f"{len(cameras)} {'camera' if len(cameras) == 1 else 'cameras'} with {lens}"


def describe_splat(path: Path, scene: Gaussians) -> str:
    """Describe the input splat."""
    mode = "antialiased " if scene.is_antialiased else ""
    return f"{quote_value(path)}, {len(scene):,} {mode}Gaussians of SH degree {scene.sh_degree}"


def describe_found(options: SceneOptions, opened: Opened, task: Task) -> str:
    """Describe the frame, the depth range and the working size."""
    format = FORMATS.get(opened.format)
    unit = f" {format.unit}" if format is not None and format.unit is not None else ""
    camera, depths = task.views[0].camera, task.depths
    sources = dict.fromkeys(SOURCE_NAMES[depths[end]] for end in ("near", "far"))
    depth = f"depths from {camera.near:.3g} to {camera.far:.3g}{unit} ({' and '.join(sources)})"
    return f"{task.frame_description.rstrip('.')}; {depth}; {describe_size(options, opened, task)}"


def describe_size(options: SceneOptions, opened: Opened, task: Task) -> str:
    """Describe the working size, and that of the photographs if it differs."""
    own = list_sizes([opened.photographs.camera(frame) for frame in task.context_frames])
    size = list_sizes([view.camera for view in task.views])
    if own == size or not isinstance(options.resolution, int):
        return f"worked at {size}"
    return f"worked at {size} (the photographs have {own}; --resolution full keeps that)"


def list_sizes(cameras: Sequence[Camera]) -> str:
    """List the different image sizes."""
    sizes = dict.fromkeys(f"{camera.width} x {camera.height}" for camera in cameras)
    return ", ".join(sizes)


def describe_work(options: CompleteOptions, task: Task) -> str:
    """Describe the context, targets, models and output."""
    chosen = " (chosen)" if options.context is None else ""
    frames = [target.frame for target in task.targets if target.frame is not None]
    others = len(task.targets) - len(frames)
    targets = [list_frames(frames)] if frames else []
    targets += [f"{others} cameras" if others > 1 else "a camera"] if others else []
    targets = targets or [f"up to {get_max_targets(options)} cameras that are found"]
    return (
        f"context from {list_frames(task.context_frames)}{chosen}, completed for "
        f"{' and '.join(targets)} by {options.reconstructor} and {options.synthesis.name} on "
        f"{task.device.type}, written to {quote_value(options.out)}"
    )


def describe_memory(options: CompleteOptions, task: Task) -> str:
    """Estimate the memory."""
    pixels = max(camera.width * camera.height for camera in task.cameras)
    images = len(task.views) + (len(task.targets) or get_max_targets(options))
    needed = estimate_bytes(pixels, images)
    if task.scene is not None and task.scene.means.device.type == "cpu":
        needed += estimate_splat_bytes(task, task.scene)
    there = read_memory_bytes()
    of = "" if there is None else f" of {format_whole_gigabytes(there)}"
    return f"up to {format_whole_gigabytes(needed)}{of} of memory"


def list_frames(frames: Sequence[int]) -> str:
    """List frame numbers, shortened."""
    names = join_names([str(frame) for frame in frames], MAX_NAMED)
    return f"{'frame' if len(frames) == 1 else 'frames'} {names}"
