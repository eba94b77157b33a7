"""A splat without photographs as the input of a completion: renders of it take their place."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.apps.inputs.captures import (
    Capture,
    RenderRequest,
    describe_capture,
    find_cameras_alone,
    search_around,
    search_around_place,
    take_from_file,
)
from gscompleter.apps.inputs.hole_kinds import (
    OBJECT_NOTE,
    HoleKind,
    SplatAloneKind,
    choose_kind,
    find_target_holes,
    mark_selected,
    pair_masks,
    read_marks,
)
from gscompleter.apps.inputs.named_photographs import (
    find_context,
    names_photograph,
    read_targets,
)
from gscompleter.apps.inputs.reading import check_sizes
from gscompleter.apps.inputs.removal import select_without_masks
from gscompleter.apps.inputs.selection import choose_context
from gscompleter.apps.inputs.splat import place_scene
from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile, Opened, Target
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.camera_files import read_cameras
from gscompleter.data.cameras import Intrinsics
from gscompleter.data.frame import Frame
from gscompleter.data.limits import check_planes
from gscompleter.data.local_origin import (
    choose_scene_origin,
    compute_frame_from_photographs,
)
from gscompleter.data.photographs import (
    Photographs,
    build_photographs,
    check_resolution,
)
from gscompleter.render.protocols import Renderer
from gscompleter.splats.alignment.trainer_frames import find_cameras_beside
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.memory import check_memory
from gscompleter.trust.lifted import find_pixel_center
from gscompleter.types import Camera, Gaussians, View
from gscompleter.virtual_capture.render_views import render_views
from gscompleter.virtual_capture.rendered_photograph import RenderedPhotograph
from gscompleter.virtual_capture.upward import estimate_axis_up, require_direction
from gscompleter.virtual_capture.witnesses import choose_witnesses

RENDERS_FORMAT = "renders"
"""Format of photographs that are renders of the splat."""
SURFACE_POINTS = 10_000
"""Gaussians that stand for the surfaces of the scene where cameras are compared. They are taken at
even steps, so that up to twice as many may be left."""
MIN_POINT_OPACITY = 0.5
"""Least opacity of such a Gaussian."""


@dataclass(frozen=True)
class OpenedAlone:
    """A splat without photographs, opened, with renders in their place."""

    opened: Opened
    task: CompletionTask
    kind: SplatAloneKind


@dataclass(frozen=True)
class ChosenCapture:
    """Cameras at which a splat is rendered, and what a hole of it is."""

    capture: Capture
    holes: HoleKind


def open_renders(
    request: RenderRequest,
    splat_file: InputSplatFile,
    scene: Gaussians,
    renderer: Renderer,
    device: str,
) -> OpenedAlone:
    """Choose cameras, and render the splat there in place of photographs.

    `scene` is in the coordinates of `splat_file`, or relative to an origin of its own, and the task
    is relative to an origin near it. Raises InputError for words, cameras or masks that cannot be
    used, and for targets without a hole.
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
    own = scene.origin
    origin = choose_scene_origin(scene, known.origin) if own is None else np.array(own)
    known = replace(known, origin=origin, near=reading.near, far=reading.far)
    targets = read_targets(known, request.targets, reading.resolution, has_splat=True)
    targets = [
        replace(target, camera=replace(target.camera, near=reading.near, far=reading.far))
        for target in targets
    ]
    all_cameras = [known.camera(number, reading.resolution) for number in range(len(known))]
    all_cameras += [target.camera for target in targets]
    scene, _ = place_scene(scene, origin, all_cameras)
    scene = scene.to(device)

    # The search for this centre takes a second, and decides several things below.
    pixel_center = find_pixel_center(scene)
    target_cameras = [target.camera.to(device) for target in targets]
    decided = choose_capture(request, path, known, target_cameras, scene, pixel_center, renderer)
    capture = decided.capture
    photographs = replace(
        known,
        frames=tuple(make_frames(capture, scene, renderer, origin)),
        format=RENDERS_FORMAT,
        sparse=partial(sample_surface_points, scene, origin),
    )
    chosen = choose_rendered(photographs, targets, request, is_from_file=path is not None)
    notes = [describe_capture(capture, len(chosen))]
    notes += [] if capture.upward is None else capture.upward.describe()
    if decided.holes == "enclosed" and not request.masks and request.marked is None:
        notes.append(OBJECT_NOTE)

    cameras = {number: capture.cameras[number].to(device) for number in chosen}
    # Cameras of a file that are not rendered know the splat as well as those that are.
    unused = [camera for number, camera in enumerate(capture.cameras) if number not in chosen]
    others = [camera.to(device) for camera in (*unused, *capture.others)]
    if capture.upward is None:
        # Cameras that somebody named stand upright.
        up = estimate_axis_up([*cameras.values(), *target_cameras])
    else:
        up = capture.upward.direction
    witnesses = choose_witnesses(scene, pixel_center, list(cameras.values()), others, up, renderer)
    check_capture_images([*cameras.values(), *target_cameras])
    opened = Opened(
        reading,
        replace(photographs, notes=tuple(notes)),
        RENDERS_FORMAT,
        len(photographs),
        renders_from=capture.source,
    )
    task = CompletionTask(
        render_context(cameras, scene, renderer, reading.uses_given_depth),
        targets,
        compute_frame_from_photographs(origin),
        origin,
        find_capture_depth_sources(reading),
        scene=scene,
        splat_file=replace(splat_file, origin=origin),
        frame_description="the frame of the splat",
        witnesses=witnesses,
    )
    return OpenedAlone(opened, task, SplatAloneKind(pixel_center is not None, decided.holes))


def choose_rendered(
    photographs: Photographs, targets: Sequence[Target], request: RenderRequest, is_from_file: bool
) -> tuple[int, ...]:
    """Choose the numbers of the cameras whose renders are the context.

    They are those that were named, or of a file those that suit the targets. Cameras that were
    found are few, and all are taken.
    """
    chosen = find_context(photographs, request.context)
    if not chosen and is_from_file:
        chosen = choose_context(photographs, targets, request.reading.resolution, has_splat=True)
    return chosen or tuple(range(len(photographs)))


def choose_capture(
    request: RenderRequest,
    path: Path | None,
    known: Photographs,
    targets: Sequence[Camera],
    scene: Gaussians,
    pixel_center: Float[Tensor, "3"] | None,
    renderer: Renderer,
) -> ChosenCapture:
    """Choose the cameras at which the splat is rendered, and what a hole of it is.

    Both in one: what a hole is depends on the cameras that somebody named, and where cameras are
    looked for depends on the holes of the targets.

    Args:
        request: The splat, and what is known of its cameras and holes.
        path: The file of cameras, named or found beside the splat; None to find cameras.
        known: The cameras of that file, with the origin that work is done near.
        targets: Cameras of the targets; none to plan them later.
        scene: Gaussians relative to that origin.
        pixel_center: Centre of the camera that the splat was lifted from; None if it was trained.
        renderer: Renders the splat where cameras are compared.
    """
    # Cameras that are found say nothing of holes: they are chosen for images that the splat fills.
    from_file = None if path is None else take_from_file(path, known, request)
    named = [] if from_file is None else from_file.cameras
    is_lifted = pixel_center is not None
    kind = choose_kind(request.kind, scene, is_lifted, [*targets, *named], renderer)
    holes = find_requested_holes(request, kind, targets, scene, known.origin, renderer)
    if from_file is not None:
        return ChosenCapture(from_file, kind)
    if request.place is not None:
        capture = search_around_place(scene, known.origin, renderer, request)
    elif not targets:
        capture = find_cameras_alone(scene, pixel_center, renderer, request)
    else:
        capture = search_around(targets, holes, scene, renderer, request)
    return ChosenCapture(capture, kind)


def find_requested_holes(
    request: RenderRequest,
    kind: HoleKind,
    targets: Sequence[Camera],
    scene: Gaussians,
    origin: Float[np.ndarray, "3"],
    renderer: Renderer,
) -> list[Bool[Tensor, "h w"]]:
    """Find the hole of each target: what is marked, or else empty; none where things are removed.

    `scene` is relative to `origin`, which is in the coordinates of the file.

    Raises:
        InputError: There is another number of masks than of targets, or no target has a hole.
    """
    # What is marked is the hole, and need not be empty yet.
    if request.masks:
        pairs = pair_masks(request.masks, targets)
        return [read_marks(path, camera, request.mask_reading) for path, camera in pairs]
    if request.marked is not None:
        chosen = select_without_masks(request.marked, scene, origin)
        return mark_selected(scene, chosen, targets, renderer)
    # What is removed leaves its hole later.
    if request.place is not None:
        return []
    return find_target_holes(targets, scene, renderer, replace(request.limits, kind=kind))


def check_capture_images(cameras: Sequence[Camera]) -> None:
    """Refuse images that are too small, or too many for the memory."""
    check_sizes(cameras)
    check_memory(max(camera.width * camera.height for camera in cameras), len(cameras))


def render_context(
    cameras: Mapping[int, Camera], scene: Gaussians, renderer: Renderer, gives_depth: bool
) -> list[View]:
    """Render the context at numbered cameras, with its depth or without."""
    views = render_views(scene, list(cameras.values()), renderer)
    numbered = zip(cameras, views, strict=True)
    return [
        replace(view, frame=number, given_depth=view.given_depth if gives_depth else None)
        for number, view in numbered
    ]


def check_words(request: RenderRequest, path: Path | None) -> None:
    """Refuse names of cameras without a file of them, and a direction that nothing follows."""
    follows_targets = bool(request.targets) and request.place is None
    if request.up is not None and (path is not None or follows_targets):
        raise InputError(
            "The cameras that are given have an upward direction of their own; leave --up out.",
            "up",
        )
    if request.up is not None:
        require_direction(request.up)
    if path is not None:
        return
    if request.context is not None:
        raise InputError(
            "Without photographs the context is a choice among the cameras of a file, and there "
            "is none; name one with --cameras.",
            "context",
        )
    for word in request.targets:
        if names_photograph(word) or not os.path.exists(word):
            raise InputError(
                f"'{quote_value(word, 60)}' is no target: there are no photographs to name, so "
                "name an existing file of cameras, such as a transforms.json.",
                "target",
            )


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
    step = max(1, len(means) // SURFACE_POINTS)
    return means[::step].double().cpu().numpy() + origin


def make_frames(
    capture: Capture, scene: Gaussians, renderer: Renderer, origin: Float[np.ndarray, "3"]
) -> list[Frame]:
    """Make the frames of the cameras, whose photographs are rendered when they are asked for."""
    frames = []
    for name, camera in zip(capture.names, capture.cameras, strict=True):
        # A copy, or a camera in float64 would be moved itself.
        c2w = camera.c2w.double().cpu().numpy().copy()
        c2w[:3, 3] += origin
        (fl_x, _, cx), (_, fl_y, cy), _ = camera.K.double().tolist()
        intrinsics = Intrinsics((camera.width, camera.height), (fl_x, fl_y), (cx, cy))
        render = RenderedPhotograph(camera, scene, renderer)
        frames.append(Frame(name, f"camera {name}", c2w, intrinsics, render))
    return frames


def find_capture_depth_sources(reading: SceneRequest) -> dict[str, str]:
    """Find the sources of `near` and `far`: the user, or renders of the splat."""
    planes = {"near": reading.near, "far": reading.far}
    return {name: "splat" if plane is None else "given" for name, plane in planes.items()}
