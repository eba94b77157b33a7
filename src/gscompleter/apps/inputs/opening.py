"""Opening of a scene: photographs, cameras and the input splat of the options."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from rich.console import Console
from torch import Tensor

from gscompleter.apps.commands.options import (
    CompleteOptions,
    SceneOptions,
    get_max_targets,
    parse_resolution,
)
from gscompleter.apps.inputs.given_depth import read_with_depth
from gscompleter.apps.inputs.selection import (
    CHECK_VIEW_SIZE,
    choose_context,
    collect_usable_cameras,
    select_near_and_far,
)
from gscompleter.apps.report.completion import InputSplatFile, Target
from gscompleter.data.camera_files import refuse_other_exports
from gscompleter.data.formats import find_format, open_photographs, refuse_scenes_below
from gscompleter.data.local_origin import (
    choose_scene_origin,
    compute_frame_from_photographs,
    shift_to_origin,
)
from gscompleter.data.photographs import Photographs
from gscompleter.data.points import add_depth_range
from gscompleter.data.scene import load_cameras
from gscompleter.data.sfm.poses import POSES, find_poses, has_photographs
from gscompleter.errors import InputError, join_names, quote_value
from gscompleter.io.files import SUMMARY_FILE
from gscompleter.memory import (
    check_bytes,
    check_memory,
    estimate_bytes,
    estimate_scene_bytes,
    format_whole_gigabytes,
    read_memory_bytes,
)
from gscompleter.reconstructors.features.depth_range import set_depth_range
from gscompleter.render import Renderer, load_renderer
from gscompleter.splat_alignment.estimate import align_splat
from gscompleter.splat_alignment.similarity import transform_camera, transform_view
from gscompleter.splat_alignment.trainer_frames import InputSplat
from gscompleter.splats.formats import FORMATS as SPLAT_FORMATS
from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.ply import find_finite_rows
from gscompleter.stages.context import find_depth_range
from gscompleter.types import Camera, Gaussians, View

MIN_IMAGE_SIZE = 16
SPLAT_EXTENSIONS = tuple(end for format in SPLAT_FORMATS.values() for end in format.extensions)
FRAME_NUMBER = re.compile("-?[0-9]{1,9}")
MAX_NAMED = 8
MAX_CHECK_VIEWS = 40


@dataclass(frozen=True)
class Opened:
    """Photographs with cameras, and their source."""

    photographs: Photographs
    format: str
    num_photographs: int
    """Number of photographs, with those whose camera was not found."""


@dataclass(frozen=True)
class Task:
    """Input of a completion."""

    views: Sequence[View]
    targets: Sequence[Target]
    frame: Float[np.ndarray, "4 4"]
    """Similarity from the frame of the photographs to that of the result."""
    origin: Float[np.ndarray, "3"]
    """Origin of the result in the coordinates of the input; zero unless those are large."""
    depths: Mapping[str, str]
    """Source of `near` and `far`: given, scene, points, splat or features."""
    scene: Gaussians | None = None
    """Input splat, or None to reconstruct the context."""
    splat_file: InputSplatFile | None = None
    method: str = "given"
    frame_description: str = "the frame of the photographs"
    check_views: Sequence[View] | None = None
    """Check views of the input splat, at low resolution."""
    depth_notes: tuple[str, ...] = ()
    """Sentences about the unit of the given depth."""

    @property
    def device(self) -> torch.device:
        """Device of the photographs."""
        return self.views[0].image.device

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the context and of the targets."""
        return [*(view.camera for view in self.views), *(t.camera for t in self.targets)]

    @property
    def target_cameras(self) -> list[Camera]:
        """Target cameras on the device of the photographs."""
        return [target.camera.to(self.device) for target in self.targets]

    @property
    def goals(self) -> list[Camera]:
        """Target cameras, or those of the context without targets."""
        return self.target_cameras or [view.camera for view in self.views]

    @property
    def context_frames(self) -> tuple[int, ...]:
        """Frame numbers of the context."""
        return tuple(view.frame for view in self.views if view.frame is not None)

    @property
    def used_frames(self) -> set[int | None]:
        """Frame numbers of the context and of the targets."""
        return {*self.context_frames, *(target.frame for target in self.targets)}


def open_scene(options: SceneOptions, console: Console) -> Opened:
    """Open the photographs or video. If they have no cameras, find them and keep them in OUT."""
    folder, poses, number = options.folder, options.out / POSES, None
    refuse_splat(folder)
    if options.format is None and has_photographs(folder) and find_format(folder) is None:
        refuse_other_exports(folder)
        refuse_scenes_below(folder)
        ours = options.overwrite or os.path.isfile(poses / SUMMARY_FILE)
        found = find_poses(folder, poses, ours, options.frames)
        print_lines(console, *found.notes)
        folder, number = poses, found.photographs
    given = open_photographs(folder, options.format, options.near, options.far)
    print_lines(console, *given.notes)
    assert given.format is not None
    if number is None:
        return Opened(given, given.format, len(given))
    return Opened(given, "photographs", number)


def refuse_splat(path: Path) -> None:
    """Refuse a file of Gaussians given as the folder of photographs."""
    if not os.path.isdir(path) and path.name.lower().endswith(SPLAT_EXTENSIONS):
        raise InputError(
            f"{quote_value(path, 80)} is a file of Gaussians, which goes to --scene; SCENE has to "
            "be the folder of its photographs, with or without cameras, or a video."
        )


def read_task(options: CompleteOptions, opened: Opened, device: str) -> Task:
    """Read the photographs and targets of the options, after checking the memory."""
    given, resolution = opened.photographs, parse_resolution(options.resolution)
    targets = read_targets(given, options)
    frames = options.context or choose_context(options, given, targets)
    cameras = [given.camera(frame, resolution) for frame in frames]
    cameras += [target.camera for target in targets]
    check_memory(max(camera.width * camera.height for camera in cameras), len(cameras))
    return make_task(options, given, frames, targets, device)


def read_photographs(options: SceneOptions, opened: Opened, device: str) -> Task:
    """Read the named photographs, or all."""
    given, resolution = opened.photographs, parse_resolution(options.resolution)
    frames = options.context or tuple(collect_usable_cameras(given, range(len(given)), resolution))
    if not frames:
        raise InputError(
            f"No photograph of {quote_value(options.folder)} can be used; name the folder that the "
            "splat was trained on."
        )
    return make_task(options, given, frames, (), device)


def make_task(
    options: SceneOptions,
    given: Photographs,
    frames: Sequence[int],
    targets: Sequence[Target],
    device: str,
) -> Task:
    """Read the photographs of `frames`, in ascending order, and those of the targets."""
    frames, resolution = sorted(frames), parse_resolution(options.resolution)
    bounded = add_depth_range(given, frames, resolution)
    targets = [
        replace(t, camera=replace(t.camera, near=bounded.near, far=bounded.far)) for t in targets
    ]
    cameras = [bounded.camera(frame, resolution) for frame in frames]
    check_sides([*cameras, *(target.camera for target in targets)])
    depth_notes: tuple[str, ...] = ()
    if options.no_given_depth:
        views = bounded.views(frames, resolution)
    else:
        views, depth_notes = read_with_depth(bounded, frames, resolution)
    return Task(
        [view.to(device) for view in views],
        [add_photograph(target, bounded, options) for target in targets],
        compute_frame_from_photographs(given.origin),
        given.origin,
        find_depth_sources(options, given, bounded),
        depth_notes=depth_notes,
    )


def move_to_splat(
    task: Task,
    scene: Gaussians,
    path: Path,
    options: SceneOptions,
    opened: Opened,
    order: Int64[Tensor, "n"] | None = None,
) -> Task:
    """Add the splat of a file to the task, and move its cameras into the splat's frame.

    `order` has the index of each Gaussian in the file if they were reordered.
    """
    given = opened.photographs
    origin = choose_scene_origin(scene, given.origin)
    scene = shift_to_origin(origin, scene, task.cameras).to(task.device)
    splat = InputSplat(path, scene, origin, options.folder)
    found = align_splat(splat, given, task.context_frames, load_renderer(task.device.type))
    return replace(
        task,
        views=[transform_view(view, found.transform) for view in task.views],
        targets=[
            replace(t, camera=transform_camera(t.camera, found.transform)) for t in task.targets
        ],
        frame=found.transform @ task.frame,
        origin=given.origin if found.method == "given" else origin,
        scene=scene,
        splat_file=replace(locate_splat(options, path), file_order=order),
        method=found.method,
        frame_description=found.describe(),
        check_views=[transform_view(view, found.transform) for view in task.check_views or ()],
    )


def locate_splat(options: SceneOptions, path: Path) -> InputSplatFile:
    """Describe the file of the input splat."""
    is_masked = options.drop_nonfinite and detect_splat_format(path) == "ply"
    return InputSplatFile(path, find_finite_rows(path) if is_masked else None)


def add_check_views(task: Task, given: Photographs) -> Task:
    """Add check views: unused photographs near the targets and all around."""
    others = [frame for frame in range(len(given)) if frame not in task.used_frames]
    cameras = collect_usable_cameras(given, others, CHECK_VIEW_SIZE)
    views = []
    for frame in select_near_and_far(task.goals, cameras, MAX_CHECK_VIEWS):
        with suppress(InputError):
            views += given.views([frame], CHECK_VIEW_SIZE)
    return replace(task, check_views=[view.to(task.device) for view in views])


def apply_working_range(task: Task, renderer: Renderer) -> Task:
    """Set the depth range of the photographs."""
    near, far = find_depth_range(task.views, task.scene, renderer)
    return replace(task, views=set_depth_range(task.views, near, far))


def check_context(options: SceneOptions) -> None:
    """Refuse an empty context, and repeated frames."""
    context = options.context
    if context is not None and not 0 < len(context) == len(set(context)):
        raise InputError(
            "--context names no frame, or one twice; name different ones, as in --context 0 4, or "
            "leave it out."
        )


def check_targets(options: CompleteOptions) -> None:
    """Refuse `--target` together with `--auto`."""
    if options.target and options.auto is not None:
        raise InputError(
            "--target and --auto are both given; use one of them, and complete the result again "
            "with the other.",
            "auto",
        )


def find_depth_sources(
    options: SceneOptions, given: Photographs, bounded: Photographs
) -> dict[str, str]:
    """Find the sources of `near` and `far`; `bounded` has those of the sparse points."""
    estimate = "features" if options.scene is None else "splat"
    sources = {"given": options, "scene": given, "points": bounded}
    return {
        name: next((s for s, held in sources.items() if getattr(held, name) is not None), estimate)
        for name in ("near", "far")
    }


def read_targets(given: Photographs, options: CompleteOptions) -> list[Target]:
    """Read the target cameras in the order of the command line."""
    resolution = parse_resolution(options.resolution)
    targets: list[Target] = []
    for word in options.target:
        if FRAME_NUMBER.fullmatch(word):
            targets.append(Target(given.camera(int(word), resolution), int(word)))
        elif os.path.exists(word):
            cameras = load_cameras(word, resolution, origin=given.origin.tolist())
            targets += [Target(camera) for camera in cameras]
        else:
            raise InputError(
                f"'{quote_value(word, 60)}' is no target: name a frame from 0 to {len(given) - 1}, "
                "or an existing file of cameras, such as a transforms.json.",
                "target",
            )
    return targets


def add_photograph(target: Target, given: Photographs, options: SceneOptions) -> Target:
    """Add its photograph to a target, if there is one."""
    if target.frame is None or not given.frame(target.frame).has_photograph():
        return target
    (view,) = given.views([target.frame], parse_resolution(options.resolution))
    return replace(target, photograph=view.image, ignore_mask=view.ignore_mask)


def check_scene(task: Task, scene: Gaussians) -> None:
    """Refuse a splat that does not fit into memory together with its photographs."""
    photographs = len(task.views) + len(task.check_views or ())
    what = f"The {len(scene):,} Gaussians of the scene and {photographs} photographs"
    remedy = "crop the scene, or give a folder with fewer photographs"
    check_bytes(estimate_memory(task, scene), what, remedy)


def estimate_memory(task: Task, scene: Gaussians | None) -> int:
    """Estimate the bytes that a completion needs, with an input splat or without."""
    pixels = max(camera.width * camera.height for camera in task.cameras)
    needed = estimate_bytes(pixels, len(task.cameras))
    if scene is None:
        return needed
    cameras = [view.camera for view in (*task.views, *(task.check_views or ()))]
    numbers = sum(part[0].numel() for part in vars(scene).values() if isinstance(part, Tensor))
    sizes = [camera.width * camera.height for camera in cameras]
    return needed + estimate_scene_bytes(len(scene), numbers, sizes)


def check_sides(cameras: Sequence[Camera]) -> None:
    """Refuse images that are too small."""
    for camera in cameras:
        if min(camera.width, camera.height) < MIN_IMAGE_SIZE:
            raise InputError(
                f"An image is {camera.width} x {camera.height} pixels, and both sides must have at "
                f"least {MIN_IMAGE_SIZE}; choose a larger --resolution, or another camera."
            )


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
        *task.depth_notes,
    ]


def name_target(target: Target) -> str:
    """Name a target for lines and tables."""
    if target.derived_from is not None:
        return f"target near {target.derived_from}"
    return "a given camera" if target.frame is None else f"target {target.frame}"


def print_lines(console: Console, *lines: str) -> None:
    """Print lines without markup."""
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
