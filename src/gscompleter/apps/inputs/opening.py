"""Opening of a scene: photographs, cameras and the input splat of the options."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int64
from rich.console import Console
from torch import Tensor

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.remove import RemoveOptions
from gscompleter.apps.commands.shared_options import LONG_SIDE, SceneOptions, parse_resolution
from gscompleter.apps.inputs.given_depth import read_with_depth
from gscompleter.apps.inputs.selection import (
    CHECK_VIEW_SIZE,
    choose_context,
    collect_usable_cameras,
    select_near_and_far,
)
from gscompleter.apps.report.completion import InputSplatFile, Target, compute_mask_fraction
from gscompleter.apps.report.names import name_photograph, name_target
from gscompleter.data.camera_files import is_in_splat_frame, refuse_other_exports
from gscompleter.data.formats import find_format, open_photographs, refuse_scenes_below
from gscompleter.data.frame import FOLDERS
from gscompleter.data.limits import check_planes
from gscompleter.data.local_origin import (
    choose_scene_origin,
    compute_frame_from_photographs,
    shift_to_origin,
)
from gscompleter.data.panorama import has_panoramas
from gscompleter.data.photographs import Photographs, check_resolution
from gscompleter.data.points import add_depth_range
from gscompleter.data.scene import load_cameras
from gscompleter.data.sfm.poses import (
    ENDINGS,
    find_poses,
    has_photographs,
    list_photograph_files,
)
from gscompleter.data.video import is_video
from gscompleter.reconstructors import Reconstructor, get_trained_range
from gscompleter.reconstructors.features.depth_range import (
    find_depth_range,
    measure_feature_depths,
    set_depth_range,
)
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.splats.alignment.estimate import align_splat
from gscompleter.splats.alignment.similarity import transform_camera, transform_view
from gscompleter.splats.alignment.trainer_frames import InputSplat
from gscompleter.splats.alignment.training_size import find_training_size
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.formats import SPLAT_FORMATS as SPLAT_FORMATS
from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.ply import find_finite_rows
from gscompleter.stages.context import find_splat_range
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.output_folder import POSES
from gscompleter.system.files.writing import SUMMARY_FILE
from gscompleter.system.memory import (
    check_bytes,
    check_memory,
    estimate_bytes,
    estimate_scene_bytes,
    format_whole_gigabytes,
    read_memory_bytes,
)
from gscompleter.types import Camera, Gaussians, View

AnyOptions = TypeVar("AnyOptions", bound=SceneOptions)

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

    @property
    def files(self) -> dict[int | None, str]:
        """Files of the photographs by frame, below the folder of all."""
        return {number: f.file_name for number, f in enumerate(self.photographs.frames)}

    def name_target(self, target: Target) -> str:
        """Name a target for lines and tables."""
        near = target.derived_from
        file = self.files.get(target.frame if near is None else near)
        return name_target(target.frame, file, near, target.offset)


@dataclass(frozen=True)
class CompletionTask:
    """Input of a completion."""

    views: Sequence[View]
    targets: Sequence[Target]
    frame: Float[np.ndarray, "4 4"]
    """Similarity from the frame of the photographs to that of the result."""
    origin: Float[np.ndarray, "3"]
    """Origin of the result in the coordinates of the input; zero unless those are large."""
    depths: Mapping[str, str]
    """Source of `near` and `far`: given, scene, points, splat, model or features."""
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


def open_scene(
    options: SceneOptions, console: Console, check: Callable[[], object] = lambda: None
) -> Opened:
    """Open the photographs or video. If they have no cameras, find them and keep them in OUT.

    `check` is called before that search, which takes minutes, and raises what would end the command
    after it.
    """
    folder = options.folder
    if not os.path.isdir(folder) and folder.name.lower().endswith(SPLAT_EXTENSIONS):
        raise InputError(
            f"{quote_value(folder, 80)} is a file of Gaussians, which goes to --scene; SCENE has "
            "to be the folder of its photographs, with or without cameras, or a video."
        )
    check_planes(options.near, options.far)
    check_resolution(parse_resolution(options.resolution))

    # Photographs without cameras: COLMAP finds them once, and a later run reads them from OUT.
    num_photographs = None
    if options.format is None and find_format(folder) is None and has_photographs(folder):
        poses = options.out / POSES
        # First all that can be refused at once, because the search takes minutes.
        refuse_other_exports(folder)
        refuse_scenes_below(folder)
        print_lines(console, *describe_cameras_above(folder))
        check_frame_numbers(options, folder)
        check()
        # A folder of poses with a summary was written by us, and may be continued or replaced.
        is_ours = options.overwrite or os.path.isfile(poses / SUMMARY_FILE)
        found_poses = find_poses(folder, poses, is_ours, options.frames)
        print_lines(console, *found_poses.notes)
        folder = poses
        num_photographs = found_poses.photographs

    photographs = open_photographs(folder, options.format, options.near, options.far)
    if not options.masks:
        photographs = photographs.leave_out_masks()
    # Masks of what is to be removed may lie in the scene, and are not those of what to ignore.
    if isinstance(options, RemoveOptions) and options.mask is not None:
        photographs = photographs.leave_out_masks_in(options.mask)
    print_lines(console, *photographs.notes)

    assert photographs.format is not None
    if num_photographs is None:
        return Opened(photographs, photographs.format, len(photographs))
    # The user gave photographs, of which COLMAP may not have found all cameras. Their number is
    # reported, and not the format and number of what COLMAP wrote.
    return Opened(photographs, "photographs", num_photographs)


def choose_working_size(
    options: AnyOptions, photographs: Photographs, console: Console
) -> AnyOptions:
    """Choose the working size unless it is given: that of the training of a splat, if smaller.

    A larger one is only reported: details beyond the default size cost much time, and no harm is
    done where a splat is rendered smaller than it was trained.
    """
    if options.resolution is not None:
        return options
    side = LONG_SIDE
    trained = None
    if options.scene is not None:
        # A few photographs are enough to find the size by.
        usable = collect_usable_cameras(
            photographs, range(min(len(photographs), MAX_NAMED)), LONG_SIDE
        )
        trained = find_training_size(options.scene, options.folder, photographs, list(usable))
    if trained is not None:
        sentence = f"{quote_value(options.scene)} was trained at {trained.long_side} px"
        sentence += f" ({quote_value(trained.source)})"
        if trained.long_side <= LONG_SIDE:
            side = trained.long_side
            sentence += ", which is the working size; --resolution changes it."
        else:
            sentence += f"; the working size stays {side} px unless --resolution changes it."
        print_lines(console, sentence)
    return replace(options, resolution=side)


def describe_cameras_above(folder: Path) -> list[str]:
    """Say that the folder above one of photographs has their cameras, which are not used."""
    if folder.name.casefold() not in FOLDERS:
        return []
    above = folder.resolve().parent
    format = find_format(above)
    # Any folder with one image has the format `photograph`, which needs no cameras.
    if format is None or format == "photograph":
        return []
    return [
        f"{quote_value(above)} has cameras of these photographs ({format}); name that folder to "
        "use them. Here they are found anew."
    ]


def check_frame_numbers(options: SceneOptions, folder: Path) -> None:
    """Refuse frames beyond the photographs whose cameras have to be found.

    Panoramas are split into several photographs each, and a video into as many as it is sharp.
    """
    # Numbers only; a name may still be that of a photograph.
    words = [str(word) for word in (*(options.context or ()), *getattr(options, "target", ()))]
    frames = [int(word) for word in words if FRAME_NUMBER.fullmatch(word)]
    if is_video(folder):
        count = options.frames
    else:
        files = list_photograph_files(folder)
        count = len(files)
        # Telling panoramas apart opens each photograph, so it is done only if a number needs it.
        if frames and has_panoramas([folder / name for name in files]):
            return

    for frame in frames:
        if not 0 <= frame < count:
            raise InputError(
                f"There is no frame {frame} among the {count} photographs of "
                f"{quote_value(folder)}; name frames from 0 to {count - 1}."
            )


def resolve_scene(options: AnyOptions) -> AnyOptions:
    """Replace a trainer's model folder in `--scene` by the splat of its newest iteration."""
    if options.scene is None:
        return options
    return replace(options, scene=resolve_splat(options.scene))


def read_task(options: CompleteOptions, opened: Opened, device: str) -> CompletionTask:
    """Read the photographs and targets of the options, after checking the memory."""
    photographs = opened.photographs
    resolution = parse_resolution(options.resolution)
    targets = read_targets(photographs, options)
    frames = find_context(options, photographs) or choose_context(options, photographs, targets)

    # Cameras are enough to estimate the memory, before any photograph is loaded.
    cameras = [photographs.camera(frame, resolution) for frame in frames]
    cameras += [target.camera for target in targets]
    check_memory(max(camera.width * camera.height for camera in cameras), len(cameras))
    return make_task(options, photographs, frames, targets, device)


def read_photographs(options: SceneOptions, opened: Opened, device: str) -> CompletionTask:
    """Read the named photographs, or all."""
    photographs = opened.photographs
    resolution = parse_resolution(options.resolution)
    frames = find_context(options, photographs)
    if not frames:
        frames = tuple(collect_usable_cameras(photographs, range(len(photographs)), resolution))
    if not frames:
        raise InputError(
            f"No photograph of {quote_value(options.folder)} can be used; name the folder that the "
            "splat was trained on."
        )
    return make_task(options, photographs, frames, (), device)


def make_task(
    options: SceneOptions,
    photographs: Photographs,
    frames: Sequence[int],
    targets: Sequence[Target],
    device: str,
) -> CompletionTask:
    """Read the photographs of `frames`, in ascending order, and those of the targets."""
    frames = sorted(frames)
    resolution = parse_resolution(options.resolution)

    # `bounded` has the depth range of the options and the scene, or that of its sparse points. The
    # targets were read before the context was known that chooses the points.
    bounded = add_depth_range(photographs, frames, resolution)
    targets = [
        replace(target, camera=replace(target.camera, near=bounded.near, far=bounded.far))
        for target in targets
    ]
    cameras = [bounded.camera(frame, resolution) for frame in frames]
    for camera in (*cameras, *(target.camera for target in targets)):
        if min(camera.width, camera.height) < MIN_IMAGE_SIZE:
            raise InputError(
                f"An image is {camera.width} x {camera.height} pixels, and both sides must have at "
                f"least {MIN_IMAGE_SIZE}; choose a larger --resolution, or another camera."
            )

    depth_notes: tuple[str, ...] = ()
    if options.no_given_depth:
        views = bounded.views(frames, resolution)
    else:
        views, depth_notes = read_with_depth(bounded, frames, resolution)
    views = [view.to(device) for view in views]

    # Photographs of the targets score the result, and only the oracle generator sees them.
    targets = [add_photograph(target, bounded, options) for target in targets]
    return CompletionTask(
        views,
        targets,
        compute_frame_from_photographs(photographs.origin),
        photographs.origin,
        find_depth_sources(options, photographs, bounded),
        depth_notes=depth_notes,
    )


def move_to_splat(
    task: CompletionTask,
    scene: Gaussians,
    path: Path,
    options: SceneOptions,
    opened: Opened,
    order: Int64[Tensor, "n"] | None = None,
) -> CompletionTask:
    """Add the splat of a file to the task, and move its cameras into the splat's frame.

    `order` has the index of each Gaussian in the file if they were reordered.
    """
    photographs = opened.photographs

    # Coordinates of maps are too large for float32, so that work is done near the scene's origin.
    origin = choose_scene_origin(scene, photographs.origin)
    scene = shift_to_origin(origin, scene, task.cameras).to(task.device)

    # A trainer may have moved and scaled the cameras before it trained the splat.
    splat = InputSplat(path, scene, origin, options.folder)
    alignment = align_splat(
        splat, photographs, task.context_frames, load_renderer(task.device.type)
    )

    # Cameras were read relative to the origin of the photographs, whatever frame they are in. Those
    # of the splat's own frame only change to its origin; all others are aligned.
    from_photographs = alignment.transform
    from_splat = compute_frame_from_photographs(origin) @ compute_frame_from_photographs(
        -photographs.origin
    )
    targets = []
    for target in task.targets:
        transform = from_splat if target.is_in_splat_frame else from_photographs
        targets.append(replace(target, camera=transform_camera(target.camera, transform)))

    return replace(
        task,
        views=[transform_view(view, from_photographs) for view in task.views],
        targets=targets,
        frame=from_photographs @ task.frame,
        origin=photographs.origin if alignment.method == "given" else origin,
        scene=scene,
        splat_file=replace(locate_splat(options, path), file_order=order),
        method=alignment.method,
        frame_description=alignment.describe(),
        check_views=[transform_view(view, from_photographs) for view in task.check_views or ()],
    )


def locate_splat(options: SceneOptions, path: Path) -> InputSplatFile:
    """Describe the file of the input splat."""
    # A .ply is written again from its own rows, of which those that were dropped are left out.
    if options.drop_nonfinite and detect_splat_format(path) == "ply":
        return InputSplatFile(path, find_finite_rows(path))
    return InputSplatFile(path, None)


def add_check_views(task: CompletionTask, photographs: Photographs) -> CompletionTask:
    """Add check views: unused photographs near the targets and all around (decision 020)."""
    others = [frame for frame in range(len(photographs)) if frame not in task.used_frames]
    cameras = collect_usable_cameras(photographs, others, CHECK_VIEW_SIZE)
    views = []
    for frame in select_near_and_far(task.goals, cameras, MAX_CHECK_VIEWS):
        with suppress(InputError):
            views += photographs.views([frame], CHECK_VIEW_SIZE)
    return replace(task, check_views=[view.to(task.device) for view in views])


def apply_splat_range(task: CompletionTask, scene: Gaussians, renderer: Renderer) -> CompletionTask:
    """Set the depth range of the photographs of an input splat; it is measured if not known."""
    near, far = find_splat_range(task.views, scene, renderer)
    return replace(task, views=set_depth_range(task.views, near, far))


def apply_scene_range(task: CompletionTask, reconstructor: Reconstructor) -> CompletionTask:
    """Set the depth range of the photographs from which Ψ reconstructs the scene."""
    # A published network has the depth range of its authors (decision 047), which takes the place
    # of a range estimated from features.
    trained = get_trained_range(reconstructor)
    near, far = find_depth_range(task.views, trained)
    depths = dict(task.depths)
    if trained is not None:
        for name, source in task.depths.items():
            if source == "features":
                depths[name] = "model"
    return replace(task, views=set_depth_range(task.views, near, far), depths=depths)


def describe_range_mismatch(task: CompletionTask, reconstructor: Reconstructor) -> list[str]:
    """Say that the scene's features lie outside of the depths that Ψ was trained on.

    Published networks sweep planes between depths that their authors chose for scenes in metres. A
    scene in another unit, as of COLMAP, has its surfaces elsewhere, and the networks cannot see it.
    """
    trained = get_trained_range(reconstructor)
    if trained is None or "model" not in task.depths.values():
        return []
    depths = measure_feature_depths(task.views)
    if depths is None:
        return []
    nearest, farthest = depths
    near, far = trained
    # The geometric mean decides: the farthest features are often mismatches.
    middle = math.sqrt(nearest * farthest)
    if near <= middle <= far:
        return []
    return [
        f"The scene lies at depths from {nearest:.2g} to {farthest:.2g}, and this model was "
        f"trained on {near:g} to {far:g} (metres); scale the cameras to metres, or give --near "
        "and --far."
    ]


def check_context(options: SceneOptions) -> None:
    """Refuse an empty context, and repeated frames."""
    context = options.context
    if context is None:
        return
    if len(context) == 0 or len(set(context)) < len(context):
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


def check_target_files(options: CompleteOptions) -> None:
    """Read the cameras of `--target`, and refuse words that are neither frames nor files."""
    for word in options.target:
        if FRAME_NUMBER.fullmatch(word):
            continue
        if not os.path.exists(word):
            raise InputError(
                f"'{quote_value(word, 60)}' is no target: name the number of a frame, or an "
                "existing file of cameras, such as a transforms.json.",
                "target",
            )
        load_cameras(word, parse_resolution(options.resolution))


def find_depth_sources(
    options: SceneOptions, photographs: Photographs, bounded: Photographs
) -> dict[str, str]:
    """Find the sources of `near` and `far`; `bounded` has those of the sparse points."""
    estimate = "features" if options.scene is None else "splat"
    # In this order: each of them keeps what the one before it has.
    sources = {"given": options, "scene": photographs, "points": bounded}
    source_by_name = {}
    for name in ("near", "far"):
        known = [source for source, value in sources.items() if getattr(value, name) is not None]
        source_by_name[name] = known[0] if known else estimate
    return source_by_name


def read_targets(photographs: Photographs, options: CompleteOptions) -> list[Target]:
    """Read the target cameras in the order of the command line."""
    resolution = parse_resolution(options.resolution)
    targets: list[Target] = []
    for word in options.target:
        if os.path.exists(word) and not is_image(word):
            cameras = load_cameras(word, resolution, origin=photographs.origin.tolist())
            is_of_splat = options.scene is not None and is_in_splat_frame(Path(word))
            targets += [Target(camera, is_in_splat_frame=is_of_splat) for camera in cameras]
        # A photograph in the working folder can be called as one of the scene, which is meant.
        else:
            frame = find_frame(photographs, word, "target")
            targets.append(Target(photographs.camera(frame, resolution), frame))
    return targets


def find_context(options: SceneOptions, photographs: Photographs) -> tuple[int, ...]:
    """Find the context frames that the options name; none if they name none."""
    frames = tuple(find_frame(photographs, word, "context") for word in options.context or ())
    # Words differ by now (`check_context`), but a name and a number can mean one photograph.
    if len(set(frames)) < len(frames):
        twice = next(frame for frame in frames if frames.count(frame) > 1)
        name = quote_value(photographs.frame(twice).file_name)
        raise InputError(f"--context names photograph {twice} ({name}) twice; name different ones.")
    return frames


def find_frame(photographs: Photographs, word: int | str, option: str) -> int:
    """Find the frame of a word of an option: a number, or the name of a photograph."""
    number = int(word) if FRAME_NUMBER.fullmatch(str(word)) else word
    try:
        return photographs.find_frame(number)
    except InputError as error:
        if option == "target" and isinstance(number, str):
            raise InputError(
                f"'{quote_value(word, 60)}' is no target: name a photograph or its number from 0 "
                f"to {len(photographs) - 1}, or an existing file of cameras, such as a "
                "transforms.json.",
                option,
            ) from error
        raise InputError(str(error), option) from error


def is_image(path: str) -> bool:
    """Return True if a path names a photograph, not a file of cameras."""
    return path.lower().endswith(ENDINGS)


def add_photograph(target: Target, photographs: Photographs, options: SceneOptions) -> Target:
    """Add its photograph to a target, if there is one."""
    if target.frame is None or not photographs.frame(target.frame).has_photograph():
        return target
    (view,) = photographs.views([target.frame], parse_resolution(options.resolution))
    return replace(target, photograph=view.image, ignore_mask=view.ignore_mask)


def check_scene(task: CompletionTask, scene: Gaussians) -> None:
    """Refuse a splat that does not fit into memory together with its photographs."""
    photographs = len(task.views) + len(task.check_views or ())
    what = f"The {len(scene):,} Gaussians of the scene and {photographs} photographs"
    remedy = "crop the scene, or give a folder with fewer photographs"
    check_bytes(estimate_memory(task, scene), what, remedy)


def estimate_memory(task: CompletionTask, scene: Gaussians | None) -> int:
    """Estimate the bytes that a completion needs, with an input splat or without."""
    pixels = max(camera.width * camera.height for camera in task.cameras)
    needed = estimate_bytes(pixels, len(task.cameras))
    if scene is None:
        return needed

    # A splat is frozen for each photograph that guards it. Its memory grows with the numbers of a
    # Gaussian, most of which are spherical harmonics.
    cameras = [view.camera for view in (*task.views, *(task.check_views or ()))]
    parts = [part for part in vars(scene).values() if isinstance(part, Tensor)]
    numbers = sum(part[0].numel() for part in parts)
    sizes = [camera.width * camera.height for camera in cameras]
    return needed + estimate_scene_bytes(len(scene), numbers, sizes)


def describe_task(options: CompleteOptions, opened: Opened, task: CompletionTask) -> list[str]:
    """Write the four lines; the cameras of `task` have the working depth range."""
    targets = join_names([opened.name_target(target) for target in task.targets], MAX_NAMED)
    files = opened.files
    context = [name_photograph(frame, files.get(frame)) for frame in task.context_frames]
    if not targets:
        count = options.max_targets
        targets = (
            "a camera that is found" if count == 1 else f"up to {count} cameras that are found"
        )
    models = f"{options.reconstructor} and {options.synthesis.generator} on {task.device.type}"

    # On a GPU the splat is in its memory, not in that of the machine.
    needed = estimate_memory(task, task.scene if task.device.type == "cpu" else None)
    available = read_memory_bytes()
    of = "" if available is None else f" of {format_whole_gigabytes(available)}"
    return [
        *describe_opening(options, opened, task),
        f"To do: complete the scene from photographs {join_names(context, MAX_NAMED)} for "
        f"{targets} by {models}, written to {quote_value(options.out)}.",
        f"Memory: up to {format_whole_gigabytes(needed)}{of}.",
    ]


def describe_opening(options: SceneOptions, opened: Opened, task: CompletionTask) -> list[str]:
    """Write the lines on the opened scene."""
    scene = task.scene
    camera = task.views[0].camera
    photographs = opened.photographs
    used = len(photographs) - len(list_missing(photographs))
    splat = ""
    if scene is not None:
        mode = "antialiased " if scene.is_antialiased else ""
        path = options.scene if task.splat_file is None else task.splat_file.path
        name = quote_value(path)  # of a model folder, the splat that was found in it
        splat = f"; {name}, {len(scene):,} {mode}Gaussians of SH degree {scene.sh_degree}"
    return [
        f"Opened: {quote_value(options.folder)}, {opened.format}, {used} of "
        f"{opened.num_photographs} photographs{splat}.",
        f"Found: {task.frame_description.rstrip('.')}; depths from {camera.near:.3g} to "
        f"{camera.far:.3g}; worked at {camera.width} x {camera.height} (--resolution changes it).",
        *describe_missing(photographs),
        *describe_masks(photographs, task),
        *task.depth_notes,
    ]


def list_missing(photographs: Photographs) -> list[str]:
    """List the names of photographs that cameras name and that are not there."""
    named = [frame for frame in photographs.frames if frame.image is not None]
    return [frame.name for frame in named if not frame.has_photograph()]


def describe_missing(photographs: Photographs) -> list[str]:
    """Say which cameras have no photograph; such a camera stays, because it can be a target."""
    missing = list_missing(photographs)
    if not missing:
        return []
    return [
        f"{len(missing)} of {len(photographs)} photographs are missing, and their cameras can only "
        f"be targets: {join_names(missing, MAX_NAMED)}."
    ]


def describe_masks(photographs: Photographs, task: CompletionTask) -> list[str]:
    """Say which masks were found for the photographs of a task, and how much they hide."""
    # Cameras from elsewhere have no frame, and no mask.
    frames = [frame for frame in task.used_frames if frame is not None]
    masks = photographs.describe_masks(sorted(frames))
    if masks is None:
        return []
    most = max(compute_mask_fraction(view.ignore_mask) for view in task.views)
    return [
        f"Masks: {masks}; what they hide, up to {100 * most:.1f} % of a photograph, is neither "
        "reconstructed nor scored (--no-masks uses it)."
    ]


def print_lines(console: Console, *lines: str) -> None:
    """Print lines without markup."""
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
