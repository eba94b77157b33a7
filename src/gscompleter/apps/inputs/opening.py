"""Opening of a scene: photographs, cameras and the input splat of the options."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from rich.console import Console
from torch import Tensor

from gscompleter.apps.commands.options import (
    CompleteOptions,
    SceneOptions,
    get_max_targets,
    parse_resolution,
)
from gscompleter.apps.report.completion import InputSplatFile, Target
from gscompleter.completer import set_depth_range
from gscompleter.data.formats import find_format, open_photographs, refuse_scenes_below
from gscompleter.data.local_origin import (
    choose_scene_origin,
    compute_frame_from_photographs,
    shift_to_origin,
)
from gscompleter.data.other_exports import refuse_other_exports
from gscompleter.data.photographs import Photographs
from gscompleter.data.points import add_depth_range
from gscompleter.data.resize import Resolution
from gscompleter.data.scene import load_cameras
from gscompleter.data.sfm.poses import POSES, find_poses, has_photographs
from gscompleter.errors import InputError, join_numbers, quote_value
from gscompleter.geometry import select_spread_cameras
from gscompleter.io.files import SUMMARY_FILE
from gscompleter.memory import (
    check_memory,
    check_scene_memory,
    count_fitting_images,
    estimate_bytes,
    estimate_scene_bytes,
)
from gscompleter.reconstructors.features.depth_range import estimate_depth_range
from gscompleter.render import Renderer, load_renderer
from gscompleter.splat_alignment.estimate import align_splat
from gscompleter.splat_alignment.similarity import transform_camera, transform_view
from gscompleter.splat_alignment.trainer_frames import InputSplat
from gscompleter.splats.formats import FORMATS as SPLAT_FORMATS
from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.ply import find_finite_rows
from gscompleter.stages.context import find_depth_range
from gscompleter.stages.select_context import (
    make_points_in_front,
    select_context,
    select_overview,
    summarize_cameras,
)
from gscompleter.types import Camera, Gaussians, View

MIN_IMAGE_SIZE = 16
"""Smallest side of an image, in pixels."""
SPLAT_EXTENSIONS = tuple(end for format in SPLAT_FORMATS.values() for end in format.extensions)
MAX_DIGITS = 9
NUM_CONTEXT, NUM_CONTEXT_WITH_SPLAT = 3, 8
"""Number of context photographs if none are named, without and with an input splat."""
NUM_CONTEXT_FOR_ALL = 8
"""Number of context photographs if no target is named either."""
NUM_DEPTH_VIEWS, CHECK_VIEW_SIZE = 6, 320
"""Photographs for depth range estimation, and the longer side of these and of check views."""
MAX_CHECK_VIEWS = 40
"""Most check views of an input splat, in addition to the context."""


@dataclass(frozen=True)
class Opened:
    """Photographs with cameras, and their source."""

    photographs: Photographs
    format: str
    num_photographs: int
    """Number of photographs, with those whose camera was not found."""

    def keep_ego_vehicle(self) -> Opened:
        """Return a copy that does not mask the vehicle that carries the camera."""
        return replace(self, photographs=self.photographs.keep_ego_vehicle())


@dataclass(frozen=True)
class ContextBudget:
    """Number of context photographs if none are named."""

    usable: int
    wanted: int
    limit: int
    """The default number, limited by memory but never below the minimum."""


@dataclass(frozen=True)
class DepthSource:
    """Source of each end of the depth range: given, scene, points, splat or features."""

    near: str
    far: str


@dataclass(frozen=True)
class Task:
    """Input of a completion."""

    views: Sequence[View]
    targets: Sequence[Target]
    frame: Float[np.ndarray, "4 4"]
    """Similarity from the frame of the photographs to that of the result."""
    origin: Float[np.ndarray, "3"]
    """Origin of the result in the coordinates of the input; zero unless those are large."""
    depths: DepthSource
    scene: Gaussians | None = None
    """Input splat, or None to reconstruct the context."""
    splat_file: InputSplatFile | None = None
    method: str = "given"
    frame_description: str = "the frame of the photographs"
    """Description of `method` for the user."""
    check_views: Sequence[View] | None = None
    """Check views of the input splat, at low resolution."""
    budget: ContextBudget | None = None
    """Number of context photographs, or None if they are named."""


def open_scene(options: SceneOptions, console: Console) -> Opened:
    """Open the photographs. If they have no cameras, find them and keep them in OUT."""
    folder, poses, number = options.folder, options.out / POSES, None
    refuse_splat(folder)
    if options.format is None and has_photographs(folder) and find_format(folder) is None:
        refuse_other_exports(folder)
        refuse_scenes_below(folder)
        ours = options.overwrite or os.path.isfile(poses / SUMMARY_FILE)
        found = find_poses(folder, poses, overwrite=ours)
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
            "be the folder of its photographs, with or without cameras."
        )


def read_task(options: CompleteOptions, opened: Opened, device: str) -> Task:
    """Read the photographs and targets of the options, after checking sizes and memory."""
    given = opened.photographs
    targets = read_targets(given, options)
    if options.context:
        return make_opened_task(options, given, options.context, targets, device, check_sizes)
    frames, budget = choose_context(options, given, targets)
    task = make_opened_task(options, given, frames, targets, device, check_sizes)
    return replace(task, budget=budget)


def read_photographs(options: SceneOptions, opened: Opened, device: str) -> Task:
    """Read the named photographs, or all."""
    given, resolution = opened.photographs, parse_resolution(options.resolution)
    frames = options.context or tuple(collect_usable_cameras(given, range(len(given)), resolution))
    if not frames:
        raise InputError(
            f"No photograph of {quote_value(options.folder)} can be used; name the folder that the "
            "splat was trained on."
        )
    return make_opened_task(options, given, frames, (), device, check_sides)


def make_opened_task(
    options: SceneOptions,
    given: Photographs,
    frames: Sequence[int],
    targets: Sequence[Target],
    device: str,
    check: Callable[[Sequence[Camera]], None],
) -> Task:
    """Read the photographs of `frames`, in ascending order, once the cameras pass `check`."""
    frames, resolution = sorted(frames), parse_resolution(options.resolution)
    bounded = add_depth_range(given, frames, resolution)
    targets = [replace(t, camera=copy_depth_range(t.camera, bounded)) for t in targets]
    cameras = [bounded.camera(frame, resolution) for frame in frames]
    check([*cameras, *(target.camera for target in targets)])
    views = [view.to(device) for view in bounded.views(frames, resolution)]
    targets = [add_photograph(target, bounded, resolution) for target in targets]
    depths = find_depth_source(options, given, bounded)
    return Task(views, targets, compute_frame_from_photographs(given.origin), given.origin, depths)


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
    given, device = opened.photographs, task.views[0].image.device
    cameras = [view.camera for view in task.views] + [target.camera for target in task.targets]
    origin = choose_scene_origin(scene, given.origin)
    scene = shift_to_origin(origin, scene, cameras).to(device)
    splat = InputSplat(path, scene, origin, options.folder)
    frames = [view.frame for view in task.views if view.frame is not None]
    found = align_splat(splat, given, frames, load_renderer(device.type))
    return replace(
        task,
        views=[transform_view(view, found.transform) for view in task.views],
        targets=[
            replace(t, camera=transform_camera(t.camera, found.transform)) for t in task.targets
        ],
        frame=found.transform @ task.frame,
        origin=given.origin if found.method == "given" else origin,
        scene=scene,
        splat_file=InputSplatFile(
            path, mask_drawable_rows(path) if options.drop_nonfinite else None, order
        ),
        method=found.method,
        frame_description=found.describe(),
        check_views=[transform_view(view, found.transform) for view in task.check_views or ()],
    )


def add_check_views(task: Task, given: Photographs) -> Task:
    """Add check views: unused photographs near the targets and all around."""
    used = {view.frame for view in task.views} | {target.frame for target in task.targets}
    others = [frame for frame in range(len(given)) if frame not in used]
    cameras = collect_usable_cameras(given, others, CHECK_VIEW_SIZE)
    wanted = [target.camera for target in task.targets] or [view.camera for view in task.views]
    views = []
    for frame in select_near_and_far(wanted, cameras, MAX_CHECK_VIEWS):
        with suppress(InputError):
            views += given.views([frame], CHECK_VIEW_SIZE)
    return replace(task, check_views=[view.to(task.views[0].image.device) for view in views])


def select_near_and_far(
    wanted: Sequence[Camera], cameras: Mapping[int, Camera], count: int
) -> list[int]:
    """Select up to `count` frames: half nearest to `wanted`, the others spread over the rest."""
    near = select_closest(wanted, cameras, count if len(cameras) <= count else count // 2)
    rest = [frame for frame in cameras if frame not in near]
    if not rest:
        return near
    far = select_spread_cameras([cameras[frame] for frame in rest], count - len(near))
    return sorted([*near, *(rest[i] for i in far)])


def apply_working_range(task: Task, renderer: Renderer) -> Task:
    """Set the depth range of the photographs."""
    near, far = find_depth_range(task.views, task.scene, renderer)
    return replace(task, views=[set_depth_range(view, near, far) for view in task.views])


def mask_drawable_rows(path: Path) -> Bool[Tensor, "n"] | None:
    """Return the mask of finite Gaussians in a .ply, or None for other formats."""
    return find_finite_rows(path) if detect_splat_format(path) == "ply" else None


def check_context(options: SceneOptions) -> None:
    """Refuse too few or repeated context frames."""
    context, needed = options.context, get_min_views(options)
    if context is not None and len(context) < needed:
        raise InputError(
            f"--context names {len(context)} frame(s), and stereo needs at least {needed}; "
            "name more, as in --context 0 4, or leave it out."
        )
    if context is not None and len(set(context)) < len(context):
        twice = [frame for frame in context if context.count(frame) > 1]
        raise InputError(
            f"--context names {join_numbers(twice)} twice, which gives "
            "identical cameras and no baseline; name different frames."
        )


def check_targets(options: CompleteOptions) -> None:
    """Refuse `--target` together with `--auto`."""
    if options.target and options.auto is not None:
        raise InputError(
            "--target and --auto are both given; use one of them, and complete the result again "
            "with the other.",
            "auto",
        )


def get_min_views(options: SceneOptions) -> int:
    """Return the minimum number of photographs."""
    return 2 if options.scene is None else 1


def choose_context(
    options: CompleteOptions, given: Photographs, targets: Sequence[Target]
) -> tuple[tuple[int, ...], ContextBudget]:
    """Choose context frames for the targets, or for the whole scene without any.

    Targets are never chosen, because their photographs score the result.
    """
    target_frames = {target.frame for target in targets}
    resolution = parse_resolution(options.resolution)
    cameras = collect_usable_cameras(
        given, [f for f in range(len(given)) if f not in target_frames], resolution
    )
    if len(cameras) < get_min_views(options):
        left = "photograph is" if len(cameras) == 1 else "photographs are"
        raise InputError(
            f"{len(cameras)} usable {left} left without the targets, and the context needs at "
            f"least {get_min_views(options)}; name fewer targets, or add photographs."
        )
    frames, candidates = list(cameras), list(cameras.values())
    wanted = [target.camera for target in targets] or summarize_cameras(candidates)
    points = given.points()
    if points is None or len(points) == 0:
        points = sample_scene_points(given, wanted, cameras)
    budget = compute_context_budget(options, candidates, targets)
    if not targets:
        chosen = select_overview(candidates, points, budget.limit)
    else:
        chosen = select_context(wanted, candidates, points, budget.limit)
    return tuple(frames[index] for index in chosen), budget


def compute_context_budget(
    options: CompleteOptions, candidates: Sequence[Camera], targets: Sequence[Target]
) -> ContextBudget:
    """Compute the number of context photographs from the defaults and the memory."""
    wanted = NUM_CONTEXT if options.scene is None else NUM_CONTEXT_WITH_SPLAT
    if not targets:
        wanted = NUM_CONTEXT_FOR_ALL
    cameras = [*candidates, *(target.camera for target in targets)]
    fit = count_fitting_images(max(camera.width * camera.height for camera in cameras))
    left = wanted if fit is None else fit - (len(targets) or get_max_targets(options))
    allowed = max(get_min_views(options), min(wanted, left))
    return ContextBudget(len(candidates), wanted, allowed)


def collect_usable_cameras(
    given: Photographs, frames: Sequence[int], resolution: Resolution
) -> dict[int, Camera]:
    """Return the valid cameras of frames that have a photograph."""
    cameras = {}
    for frame in frames:
        try:
            if given.has_photograph(frame):
                cameras[frame] = given.camera(frame, resolution)
        except InputError:
            continue
    return cameras


def select_closest(
    targets: Sequence[Camera], cameras: Mapping[int, Camera], count: int
) -> list[int]:
    """Select the frames whose cameras are nearest to a target, in ascending order."""
    centers = torch.stack([target.center for target in targets])
    distance = {f: (centers - c.center).norm(dim=-1).min().item() for f, c in cameras.items()}
    return sorted(sorted(cameras, key=distance.__getitem__)[:count])


def sample_scene_points(
    given: Photographs, targets: Sequence[Camera], cameras: dict[int, Camera]
) -> Float[Tensor, "n 3"]:
    """Sample points in front of the targets within the known or estimated depth range."""
    near, far = given.near, given.far
    if near is None or far is None:
        frames = select_closest(targets, cameras, NUM_DEPTH_VIEWS)
        low, high = estimate_depth_range(given.views(frames, CHECK_VIEW_SIZE))
        near, far = low if near is None else near, high if far is None else far
    return torch.cat([make_points_in_front(target, near, far) for target in targets])


def find_depth_source(
    options: SceneOptions, given: Photographs, bounded: Photographs
) -> DepthSource:
    """Find the source of each end of the depth range."""

    def teller(name: str) -> str:
        if getattr(options, name) is not None:
            return "given"
        if getattr(given, name) is not None:
            return "scene"
        if getattr(bounded, name) is not None:
            return "points"
        return "features" if options.scene is None else "splat"

    return DepthSource(teller("near"), teller("far"))


def read_targets(given: Photographs, options: CompleteOptions) -> list[Target]:
    """Read the target cameras in the order of the command line."""
    resolution = parse_resolution(options.resolution)
    targets = []
    for word in options.target:
        frame = parse_frame_number(word)
        if frame is None:
            check_target_file(word, given)
            cameras = load_cameras(word, resolution, origin=given.origin.tolist())
            targets += [Target(camera) for camera in cameras]
        else:
            targets.append(Target(given.camera(frame, resolution), frame))
    return targets


def check_target_file(word: str, given: Photographs) -> None:
    """Refuse a target that is neither a frame number nor a file."""
    if not os.path.exists(word):
        raise InputError(
            f"'{quote_value(word, 60)}' is no target: a target is the number of a frame, from 0 to "
            f"{len(given) - 1}, or a file of cameras (transforms.json, cameras.json, COLMAP's "
            "images.txt, SuperSplat's poses), and there is no such file.",
            "target",
        )


def copy_depth_range(camera: Camera, photographs: Photographs) -> Camera:
    """Set the depth range of a camera."""
    return replace(camera, near=photographs.near, far=photographs.far)


def add_photograph(target: Target, given: Photographs, resolution: Resolution) -> Target:
    """Add its photograph to a target, if there is one."""
    if target.frame is None or not given.has_photograph(target.frame):
        return target
    (view,) = given.views([target.frame], resolution)
    return replace(target, photograph=view.image, ignore_mask=view.ignore_mask)


def check_sizes(cameras: Sequence[Camera]) -> None:
    """Refuse images that are too small, or too large for the memory."""
    check_sides(cameras)
    check_memory(max(camera.width * camera.height for camera in cameras), len(cameras))


def check_scene(task: Task, scene: Gaussians) -> None:
    """Refuse a splat that does not fit into memory together with its photographs."""
    cameras = [v.camera for v in task.views] + [target.camera for target in task.targets]
    pixels = max(camera.width * camera.height for camera in cameras)
    needed = estimate_bytes(pixels, len(cameras)) + estimate_splat_bytes(task, scene)
    check_scene_memory(len(scene), len(task.views) + len(task.check_views or ()), needed)


def estimate_splat_bytes(task: Task, scene: Gaussians) -> int:
    """Estimate the additional memory of an input splat, in bytes."""
    cameras = [view.camera for view in (*task.views, *(task.check_views or ()))]
    parts = [part for part in vars(scene).values() if isinstance(part, Tensor)]
    numbers = sum(part[0].numel() for part in parts)
    sizes = [camera.width * camera.height for camera in cameras]
    return estimate_scene_bytes(len(scene), numbers, sizes)


def check_sides(cameras: Sequence[Camera]) -> None:
    """Refuse images that are too small."""
    for camera in cameras:
        if min(camera.width, camera.height) < MIN_IMAGE_SIZE:
            raise InputError(
                f"An image is {camera.width} x {camera.height} pixels, and both sides must have at "
                f"least {MIN_IMAGE_SIZE}; choose a larger --resolution, or another camera."
            )


def parse_frame_number(word: str) -> int | None:
    """Parse a frame number; None if the word is a file name."""
    if re.fullmatch("-?[0-9]+", word) is None:
        return None
    if len(word) > MAX_DIGITS:
        raise InputError(
            f"There is no frame {quote_value(word)}; name one by its number.", "target"
        )
    return int(word)


def print_lines(console: Console, *lines: str) -> None:
    """Print lines without markup."""
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
