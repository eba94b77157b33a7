"""A splat without photographs as the input of a completion: renders of it take their place."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from gscompleter.apps.inputs.named_photographs import PhotographNames, find_context, read_targets
from gscompleter.apps.inputs.reading import check_sizes
from gscompleter.apps.inputs.scene_request import SceneRequest
from gscompleter.apps.inputs.selection import choose_context
from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile, Opened
from gscompleter.config import HoleConfig
from gscompleter.data.camera_files import NAME, has_camera_list, read_cameras
from gscompleter.data.cameras import Intrinsics
from gscompleter.data.frame import Frame
from gscompleter.data.limits import check_planes
from gscompleter.data.local_origin import (
    choose_scene_origin,
    compute_frame_from_photographs,
    shift_to_origin,
)
from gscompleter.data.photographs import Photographs, build_photographs, check_resolution
from gscompleter.numerics.geometry import add_near_plane, is_same_camera
from gscompleter.render.protocols import Renderer
from gscompleter.stages.target_view import compute_hole_mask, explain_little_covered
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.system.memory import check_memory
from gscompleter.types import Camera, Gaussians
from gscompleter.virtual_capture.around_target import NUM_CAMERAS, choose_cameras_around
from gscompleter.virtual_capture.render_views import render_views

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
    holes: HoleConfig = HoleConfig()
    """What counts as a hole."""


@dataclass(frozen=True)
class Capture:
    """Cameras at which the splat can be rendered in place of photographs."""

    cameras: Sequence[Camera]
    names: Sequence[str]
    source: str
    """`cameras` of a file, or found around the `targets`."""
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
) -> tuple[Opened, CompletionTask]:
    """Choose cameras, and render the splat there in place of photographs."""
    reading = request.reading
    check_planes(reading.near, reading.far)
    check_resolution(reading.resolution)
    path = request.cameras or find_cameras_beside(reading.folder)
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

    check_targets([target.camera.to(device) for target in targets], scene, renderer, request.holes)
    if path is None:
        capture = search_around([target.camera.to(device) for target in targets], scene, renderer)
    else:
        capture = take_from_file(path, known, request)
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
    note = describe_capture(capture, len(chosen))

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
    photographs = replace(photographs, notes=(note,))
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
    return opened, task


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
    """Refuse a splat of which nothing is known, and names of cameras without a file of them."""
    if path is not None:
        return
    if not request.targets:
        raise InputError(
            "The file of the splat does not tell where to stand or what is missing; name a camera "
            "to complete it for with --target, or the cameras it was made from with --cameras, or "
            "its photographs as SCENE."
        )
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


def check_targets(
    targets: Sequence[Camera], scene: Gaussians, renderer: Renderer, config: HoleConfig
) -> None:
    """Refuse targets that see nearly nothing of a splat, or of which none sees a hole."""
    reasons: list[str] = []
    for target in targets:
        render = renderer.render(scene, add_near_plane(target, scene.means))
        covered = render.depth_map().valid.float().mean().item()
        reason = explain_little_covered(covered, config)
        if reason is None and not compute_hole_mask(render.alpha, config).any():
            reason = OPAQUE
        # One target that can be completed is enough; the report says why others were not.
        if reason is None:
            return
        reasons.append(reason)
    if reasons:
        raise InputError(reasons[0], "target")


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


def search_around(targets: Sequence[Camera], scene: Gaussians, renderer: Renderer) -> Capture:
    """Search for cameras around all targets."""
    # Fewer around each of many targets.
    count = max(1, min(NUM_CAMERAS, MAX_AROUND // max(len(targets), 1)))
    cameras: list[Camera] = []
    for target in targets:
        for camera in choose_cameras_around(scene, target, renderer, count=count):
            if not any(is_same_camera(camera, other) for other in cameras):
                cameras.append(replace(camera, near=target.near, far=target.far))
    names = [f"render {number}" for number in range(1, len(cameras) + 1)]
    where = "cameras that were found around the targets"
    return Capture(cameras, names, "targets", where, "; --cameras names others")


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
