"""A splat without photographs as the input of a completion: renders of it take their place."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from gscompleter.apps.inputs.named_photographs import PhotographNames, find_context, read_targets
from gscompleter.apps.inputs.reading import check_sizes
from gscompleter.apps.inputs.removal import Selection, select_gaussians
from gscompleter.apps.inputs.scene_request import LONG_SIDE, SceneRequest
from gscompleter.apps.inputs.selection import choose_context
from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile, Opened
from gscompleter.config import HoleConfig
from gscompleter.data.camera_files import NAME, has_camera_list, read_cameras
from gscompleter.data.cameras import Intrinsics, has_same_aspect
from gscompleter.data.frame import Frame
from gscompleter.data.limits import check_planes
from gscompleter.data.local_origin import (
    choose_scene_origin,
    compute_frame_from_photographs,
    shift_to_origin,
)
from gscompleter.data.photographs import (
    Photographs,
    Resolution,
    build_photographs,
    check_resolution,
)
from gscompleter.numerics.geometry import add_near_plane, is_same_camera
from gscompleter.render.protocols import Renderer
from gscompleter.stages.enclosed_holes import keep_enclosed
from gscompleter.stages.target_view import compute_hole_mask, explain_little_covered
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import convert_to_pixels, read_mask
from gscompleter.system.memory import check_memory
from gscompleter.types import Camera, Gaussians
from gscompleter.virtual_capture.around_target import NUM_CAMERAS, choose_cameras_around
from gscompleter.virtual_capture.kind import is_object
from gscompleter.virtual_capture.pixel_aligned import (
    find_pixel_camera,
    find_pixel_center,
    move_beside,
)
from gscompleter.virtual_capture.render_views import render_views
from gscompleter.virtual_capture.standpoints import choose_cameras_around_place, find_standpoints

HoleKind = Literal["all", "enclosed"]

FORMAT = "renders"
"""Format of photographs that are renders of the splat."""
MAX_AROUND = 12
"""Most cameras around all targets together: each takes the memory of a frozen scene."""
MAX_POINTS = 10_000
"""Gaussians that stand for the surfaces of the scene where cameras are compared."""
MIN_POINT_OPACITY = 0.5
"""Least opacity of such a Gaussian."""
OPAQUE = (
    "The splat is opaque everywhere in the image of the target, and nothing in it tells what is "
    "wrong; mark that with --mask, or name the photographs of the scene as SCENE."
)
NOTHING_ENCLOSED = (
    "The splat is an object on nothing, and its only hole there is the space around it, which "
    "stays empty; mark what is wrong with --mask, or fill all that is empty with --holes all."
)
OBJECT_NOTE = (
    "The splat is an object on nothing: only holes that it encloses are filled (--holes all fills "
    "what is around it, too)."
)
USUAL_UP = (0.0, -1.0, 0.0)
"""Upward direction of most files: the cameras of photographs point y down."""
MIN_FOUND_COVERED = 0.9
"""Least share of its image in which a camera that was found sees the splat."""
NUM_STANDPOINTS = 6
"""Most cameras from which a trained splat looks well."""
MIN_FOUND_SIDE = 64
"""Least width and height of such a camera, in pixels."""
TRAINER_LEVELS = 2
"""Folders between the cameras.json of a trainer and its point_cloud/iteration_N/*.ply."""


@dataclass(frozen=True)
class RenderRequest:
    """A splat without photographs, and what is known of its cameras."""

    reading: SceneRequest
    """Resolution and depth range; its folder is the file of the splat."""
    cameras: Path | None = None
    """File of cameras whose renders take the place of photographs, or None to find cameras."""
    targets: tuple[str, ...] = ()
    """Files of cameras, or numbers and names of cameras of `cameras`."""
    context: PhotographNames | None = None
    """Numbers or names of the cameras to use; None to choose."""
    masks: tuple[Path, ...] = ()
    """Masks that mark what is wrong at each target, white there."""
    holes: HoleConfig = HoleConfig()
    """What counts as a hole, but for its kind."""
    kind: Literal["auto", "all", "enclosed"] = "auto"
    """Kind of holes; `auto` takes those that an object encloses, and all in a scene."""
    up: tuple[float, float, float] | None = None
    """Upward direction of a splat whose cameras are found; None for that of most files, -y."""
    place: Selection | None = None
    """What is to be removed, around which cameras are found; None to complete the splat."""
    takes_standpoints: bool = False
    """True to stand anywhere if nothing tells where the cameras were."""


@dataclass(frozen=True)
class Capture:
    """Cameras at which the splat can be rendered in place of photographs."""

    cameras: Sequence[Camera]
    names: Sequence[str]
    source: str
    """`cameras` of a file, found around the `targets` or the `place` of a removal, from the sizes
    of `pixels`, or `standpoints`."""
    where: str
    """Clause that says which cameras they are."""
    more: str
    """Clause on what else could be given; empty if the user named the cameras."""


def open_renders(
    request: RenderRequest,
    splat_file: InputSplatFile,
    scene: Gaussians,
    renderer: Renderer,
    device: str,
) -> tuple[Opened, CompletionTask, HoleKind]:
    """Choose cameras, and render the splat there in place of photographs.

    Also returns what a hole of this splat is.
    """
    reading = request.reading
    check_planes(reading.near, reading.far)
    check_resolution(reading.resolution)
    # Around what is removed, cameras are found; those of a file have to be named.
    beside = find_cameras_beside(reading.folder) if request.place is None else None
    path = request.cameras or beside
    check_words(request, path)

    # Coordinates of maps are too large for float32, so that work is done near a local origin.
    known = read_known_cameras(path, request)
    origin = choose_scene_origin(scene, known.origin)
    known = replace(known, origin=origin, near=reading.near, far=reading.far)
    targets = read_targets(known, request.targets, reading.resolution, has_splat=True)
    targets = [
        replace(target, camera=replace(target.camera, near=reading.near, far=reading.far))
        for target in targets
    ]
    all_cameras = [known.camera(number, reading.resolution) for number in range(len(known))]
    all_cameras += [target.camera for target in targets]
    scene = shift_to_origin(origin, scene, all_cameras).to(device)

    target_cameras = [target.camera.to(device) for target in targets]
    if path is not None:
        capture = take_from_file(path, known, request)
        near_cameras = target_cameras or capture.cameras
    elif request.place is not None:
        capture = search_around_place(scene, origin, renderer, request)
        near_cameras = capture.cameras
    elif targets:
        capture = None
        near_cameras = target_cameras
    else:
        capture = find_cameras_alone(scene, renderer, request)
        near_cameras = capture.cameras
    kind = choose_kind(request.kind, scene, near_cameras, renderer)
    holes = [read_marks(*pair) for pair in pair_masks(request.masks, target_cameras)]
    # A removal makes its hole itself.
    if not holes and request.place is None:
        config = replace(request.holes, kind=kind)
        holes = find_target_holes(target_cameras, scene, renderer, config)
    if capture is None:
        capture = search_around(target_cameras, holes, scene, renderer)
    photographs = replace(
        known,
        frames=tuple(make_frames(capture, scene, renderer, origin)),
        format=FORMAT,
        sparse=partial(sample_surface_points, scene, origin),
    )
    chosen = find_context(photographs, request.context)
    if not chosen and path is not None:
        chosen = choose_context(photographs, targets, reading.resolution, has_splat=True)
    chosen = chosen or tuple(range(len(capture.cameras)))
    notes = [describe_capture(capture, len(chosen))]
    if kind == "enclosed" and not request.masks:
        notes.append(OBJECT_NOTE)

    context = [capture.cameras[number].to(device) for number in chosen]
    cameras = [*context, *(target.camera for target in targets)]
    check_sizes(cameras)
    check_memory(max(camera.width * camera.height for camera in cameras), len(cameras))
    views = render_views(scene, context, renderer)
    views = [
        replace(
            view,
            frame=number,
            given_depth=view.given_depth if reading.uses_given_depth else None,
        )
        for number, view in zip(chosen, views, strict=True)
    ]
    photographs = replace(photographs, notes=tuple(notes))
    opened = Opened(reading, photographs, FORMAT, len(photographs), renders_from=capture.source)
    task = CompletionTask(
        views,
        targets,
        compute_frame_from_photographs(origin),
        origin,
        find_depth_sources(reading),
        scene=scene,
        splat_file=splat_file,
        frame_description="the frame of the splat",
    )
    return opened, task, kind


def find_cameras_beside(splat: Path) -> Path | None:
    """Find the cameras.json beside a splat, or in the folder of its trainer; None without one."""
    folder = splat.resolve().parent
    # The trainers of 3DGS write point_cloud/iteration_30000/point_cloud.ply below cameras.json.
    folders = [folder]
    if folder.parent.name == "point_cloud":
        folders.append(folder.parents[TRAINER_LEVELS - 1])
    found = [place / NAME for place in folders if has_camera_list(place / NAME)]
    return found[0] if found else None


def check_words(request: RenderRequest, path: Path | None) -> None:
    """Refuse names of cameras without a file of them, and a direction that nothing follows."""
    follows_targets = bool(request.targets) and request.place is None
    if request.up is not None and (path is not None or follows_targets):
        raise InputError(
            "The cameras that are given have an upward direction of their own; leave --up out.",
            "up",
        )
    if request.up is not None and not any(request.up):
        raise InputError("The upward direction is three numbers that are not all zero.", "up")
    if path is not None:
        return
    if request.context is not None:
        raise InputError(
            "Without photographs the context is a choice among the cameras of a file, and there "
            "is none; name one with --cameras.",
            "context",
        )
    for word in request.targets:
        if not os.path.exists(word):
            raise InputError(
                f"'{quote_value(word, 60)}' is no target: there are no photographs to name, so "
                "name an existing file of cameras, such as a transforms.json.",
                "target",
            )


def choose_kind(
    kind: str, scene: Gaussians, cameras: Sequence[Camera], renderer: Renderer
) -> HoleKind:
    """Choose what a hole is: of an object on nothing, only what it encloses."""
    if kind == "enclosed" or (
        kind == "auto"
        and find_pixel_center(scene) is None
        and is_object(scene, [camera.to(scene.means.device) for camera in cameras], renderer)
    ):
        return "enclosed"
    return "all"


def find_target_holes(
    targets: Sequence[Camera], scene: Gaussians, renderer: Renderer, config: HoleConfig
) -> list[Bool[Tensor, "h w"]]:
    """Find the holes that each target sees; refuse targets if none of them can be completed."""
    reasons = []
    holes = []
    for target in targets:
        ranged = add_near_plane(target, scene.means)
        render = renderer.render(scene, ranged)
        covered = render.depth_map().valid.float().mean().item()
        reason = explain_little_covered(covered, config)
        empty = compute_hole_mask(render.alpha, config)
        if reason is None and not empty.any():
            reason = OPAQUE
        if config.kind == "enclosed":
            empty = keep_enclosed(empty, render, ranged, partial(renderer.render, scene))
        if reason is None and not empty.any():
            reason = NOTHING_ENCLOSED
        reasons.append(reason)
        holes.append(empty)
    # One target that can be completed is enough; the report says why others were not.
    if reasons and None not in reasons:
        raise InputError(str(reasons[0]), "target")
    return holes


def pair_masks(masks: Sequence[Path], targets: Sequence[Camera]) -> list[tuple[Path, Camera]]:
    """Pair masks with the targets that they belong to, in order."""
    if masks and len(masks) != len(targets):
        raise InputError(
            f"There are {len(masks)} masks and {len(targets)} target cameras; give a mask for each "
            "target, in their order.",
            "mask",
        )
    return list(zip(masks, targets, strict=True)) if masks else []


def read_marks(path: Path, target: Camera) -> Bool[Tensor, "h w"]:
    """Read the white pixels of a mask at the size of its target."""
    white = ~read_mask(path)
    size = white.shape[1], white.shape[0]
    if not has_same_aspect(size, (target.width, target.height)):
        raise InputError(
            f"{quote_value(path)} has {size[0]} × {size[1]} pixels, and its target has the aspect "
            f"ratio of {target.width} × {target.height}; paint it on the image of the target.",
            "mask",
        )
    if not white.any() or white.all():
        raise InputError(
            f"{quote_value(path)} marks {'all' if white.all() else 'nothing'} of its target; paint "
            "white what is wrong, and black what is right.",
            "mask",
        )
    mask = torch.from_numpy(white).to(target.K.device)[None, None].float()
    size_at_target = (target.height, target.width)
    # A pixel is marked if half of it is.
    return interpolate(mask, size=size_at_target, mode="area")[0, 0] >= 0.5


def read_known_cameras(path: Path | None, request: RenderRequest) -> Photographs:
    """Read the cameras of a file, without photographs; without a file there are none.

    The origin is then that of the targets.
    """
    resolution = request.reading.resolution
    if path is not None:
        return build_photographs(path.stem, str(path), read_cameras(path, resolution))
    frames = [frame for word in request.targets for frame in read_cameras(Path(word), resolution)]
    return replace(build_photographs("targets", "targets", frames), frames=())


def sample_surface_points(
    scene: Gaussians, origin: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Sample the means of opaque Gaussians, in the coordinates of the file."""
    means = scene.means[scene.opacities >= MIN_POINT_OPACITY]
    step = max(1, len(means) // MAX_POINTS)
    return means[::step].double().cpu().numpy() + origin


def take_from_file(path: Path, known: Photographs, request: RenderRequest) -> Capture:
    """Take all cameras of a file."""
    where = f"cameras of {quote_value(path)}"
    more = ""
    if request.cameras is None:
        where += ", which was found beside the splat,"
        more = "; --cameras names another file"
    cameras = [known.camera(number, request.reading.resolution) for number in range(len(known))]
    names = [frame.file_name for frame in known.frames]
    return Capture(cameras, names, "cameras", where, more)


def find_cameras_alone(scene: Gaussians, renderer: Renderer, request: RenderRequest) -> Capture:
    """Find cameras by the splat alone.

    That of a pixel-aligned splat is taken with small moves of it; a trained splat tells no more
    than from where it looks well.
    """
    resolution = request.reading.resolution
    # Two photographs are the fewest, so that no image had more pixels than half of the Gaussians.
    side = max(MIN_FOUND_SIDE, round((len(scene) / 2) ** 0.5))
    sides = (side,) if resolution is None else (side, *np.ravel(resolution).tolist())
    up = scene.means.new_tensor(request.up or USUAL_UP)
    camera = find_pixel_camera(scene, up, min(sides))
    if camera is None and request.takes_standpoints:
        return find_standing_cameras(scene, renderer, request)
    if camera is None:
        raise InputError(
            "The file of the splat does not tell where to stand or what is missing; name a camera "
            "to complete it for with --target, or the cameras it was made from with --cameras, or "
            "its photographs as SCENE."
        )
    ranged = add_near_plane(camera, scene.means)
    seen = renderer.render(scene, ranged).depth_map()
    covered = seen.valid.float().mean().item()
    if covered < MIN_FOUND_COVERED:
        raise InputError(
            f"The camera that fits the splat sees it in {covered:.0%} of its image, and at least "
            f"{MIN_FOUND_COVERED:.0%} are needed to trust it; name a camera with --target, or the "
            "cameras it was made from with --cameras."
        )
    depth = seen.depth[seen.valid].median().item()
    cameras = [
        replace(moved, near=request.reading.near, far=request.reading.far)
        for moved in move_beside(camera, depth)
    ]
    where = "cameras that follow from the sizes of its Gaussians"
    return name_capture(cameras, "pixels", where)


def find_standing_cameras(scene: Gaussians, renderer: Renderer, request: RenderRequest) -> Capture:
    """Find cameras from which a trained splat looks like a photograph."""
    up = scene.means.new_tensor(request.up or USUAL_UP)
    side = choose_side(request.reading.resolution)
    cameras = find_standpoints(scene, up, side, renderer, NUM_STANDPOINTS)
    if not cameras:
        raise InputError(
            "There is no place from which the splat looks like a photograph; name its cameras with "
            "--cameras, or which way is up with --up."
        )
    return name_capture(cameras, "standpoints", "cameras from which it looks like a photograph")


def search_around_place(
    scene: Gaussians,
    origin: Float[np.ndarray, "3"],
    renderer: Renderer,
    request: RenderRequest,
) -> Capture:
    """Search for cameras around what is to be removed."""
    assert request.place is not None
    chosen = select_gaussians(request.place, scene, origin)
    up = scene.means.new_tensor(request.up or USUAL_UP)
    side = choose_side(request.reading.resolution)
    cameras = choose_cameras_around_place(scene, chosen, up, side, renderer)
    if not cameras:
        raise InputError(
            "No camera around what is to be removed sees it unhidden; name cameras with --cameras, "
            "or which way is up with --up."
        )
    return name_capture(cameras, "place", "cameras around what is removed")


def choose_side(resolution: Resolution) -> int:
    """Choose the width and height of cameras that are found by the splat alone."""
    if isinstance(resolution, (tuple, list)):
        return max(resolution)
    return resolution if isinstance(resolution, int) else LONG_SIDE


def name_capture(cameras: Sequence[Camera], source: str, where: str) -> Capture:
    """Name cameras that were found."""
    names = [f"render {number}" for number in range(1, len(cameras) + 1)]
    return Capture(cameras, names, source, where, "; --cameras names others")


def search_around(
    targets: Sequence[Camera],
    holes: Sequence[Bool[Tensor, "h w"]],
    scene: Gaussians,
    renderer: Renderer,
) -> Capture:
    """Search for cameras around the holes of all targets."""
    # Fewer around each of many targets.
    count = max(1, min(NUM_CAMERAS, MAX_AROUND // max(len(targets), 1)))
    cameras: list[Camera] = []
    for target, hole in zip(targets, holes, strict=True):
        for camera in choose_cameras_around(scene, target, renderer, hole, count):
            if not any(is_same_camera(camera, other) for other in cameras):
                cameras.append(replace(camera, near=target.near, far=target.far))
    return name_capture(cameras, "targets", "cameras that were found around the targets")


def describe_capture(capture: Capture, num_chosen: int) -> str:
    """Write the sentence on the cameras whose renders take the place of photographs."""
    total = len(capture.cameras)
    count = f"{total}" if num_chosen == total else f"{num_chosen} of the {total}"
    return (
        f"There are no photographs: renders of the splat at {count} {capture.where} take their "
        f"place{capture.more}."
    )


def make_frames(
    capture: Capture, scene: Gaussians, renderer: Renderer, origin: Float[np.ndarray, "3"]
) -> list[Frame]:
    """Make the frames of the cameras, whose photographs are rendered when they are asked for."""
    frames = []
    for name, camera in zip(capture.names, capture.cameras, strict=True):
        c2w = camera.c2w.double().cpu().numpy()
        c2w[:3, 3] += origin
        (fl_x, _, cx), (_, fl_y, cy), _ = camera.K.double().tolist()
        intrinsics = Intrinsics((camera.width, camera.height), (fl_x, fl_y), (cx, cy))
        read = partial(encode_render, camera, scene, renderer)
        frames.append(Frame(name, f"camera {name}", c2w, intrinsics, read))
    return frames


def encode_render(camera: Camera, scene: Gaussians, renderer: Renderer) -> bytes:
    """Encode the render at a camera as a PNG that is transparent where nothing is known."""
    (view,) = render_views(scene, [camera], renderer)
    alpha = view.valid_mask.to(torch.uint8).mul(255).cpu().numpy()
    pixels = np.dstack([convert_to_pixels(view.image), alpha])
    file = BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return file.getvalue()


def find_depth_sources(reading: SceneRequest) -> dict[str, str]:
    """Find the sources of `near` and `far`: the user, or renders of the splat."""
    planes = {"near": reading.near, "far": reading.far}
    return {name: "splat" if plane is None else "given" for name, plane in planes.items()}
