"""Cameras at which renders of a splat take the place of photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.apps.inputs.named_photographs import PhotographNames
from gscompleter.apps.inputs.removal import select_without_masks
from gscompleter.apps.requests.scene import DEFAULT_LONG_SIDE, SceneRequest
from gscompleter.apps.requests.splat import Selection
from gscompleter.config import HoleConfig
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.photograph_names import name_render
from gscompleter.data.photographs import Photographs
from gscompleter.data.scene import load_cameras
from gscompleter.numerics.geometry import (
    add_near_plane,
    is_inside,
    is_same_camera,
    project,
    select_spread_cameras,
    shrink_camera,
)
from gscompleter.render.protocols import Renderer
from gscompleter.splats.alignment.trainer_frames import find_cameras_beside
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import Camera, Gaussians
from gscompleter.virtual_capture.around_target import MAX_CHOSEN_CAMERAS, choose_cameras_around
from gscompleter.virtual_capture.pixel_aligned import aim_pixel_camera, move_beside
from gscompleter.virtual_capture.standpoints import choose_cameras_around_place, find_standpoints
from gscompleter.virtual_capture.upward import Upward, find_upward
from gscompleter.virtual_capture.witnesses import MAX_WITNESSES

MAX_AROUND = 12
"""Most cameras around all targets together, as each takes the memory of a frozen scene; around more
targets than these, one each."""
MIN_FOUND_COVERED = 0.9
"""Least share of its image in which a camera that was found sees the splat."""
NUM_STANDPOINTS = 6
"""Most cameras from which a trained splat looks well, at which it is rendered."""
MAX_LISTED_CAMERAS = 4
"""Most cameras of the list beside a splat that join those around a place."""
MIN_SEEN_PLACE = 0.5
"""Least share of the place that such a camera has in its image."""
MIN_FOUND_SIDE = 64
"""Least width and height of the camera of a pixel-aligned splat, in pixels, however few its
Gaussians are."""

CaptureSource = Literal["cameras", "targets", "place", "pixels", "standpoints"]
"""How cameras were come by.

`cameras` are those of a file. All others were found: around the holes of `targets`; around the
`place` of a removal; from the sizes of Gaussians that were lifted from `pixels`; or as
`standpoints`, from which a trained splat looks like a photograph.
"""


@dataclass(frozen=True, kw_only=True)
class RenderRequest:
    """A splat without photographs, and what is known of its cameras and its holes."""

    reading: SceneRequest
    """Resolution and depth range; its folder is the file of the splat."""

    # Cameras.
    cameras: Path | None = None
    """File of cameras whose renders take the place of photographs, or None to find cameras."""
    targets: tuple[str, ...] = ()
    """Files of cameras, or numbers and names of cameras of `cameras`."""
    context: PhotographNames | None = None
    """Numbers or names of the cameras to use; None to choose."""
    up: tuple[float, float, float] | None = None
    """Upward direction of a splat whose cameras are found, in the axes of its file; None to find
    it."""

    # Holes: what is removed, what masks mark, or else what is empty.
    place: Selection | None = None
    """Gaussians to be removed, around which cameras are found; None to complete the splat."""
    masks: tuple[Path, ...] = ()
    """Masks that mark what is wrong at each target, white there."""
    mask_reading: MaskReading = MaskReading()
    """How these are read."""
    marked: Selection | None = None
    """Gaussians that are wrong, in place of masks; their hole is what the targets see of them."""
    kind: Literal["auto", "all", "enclosed"] = "auto"
    """Kind of holes; `auto` takes those that an object encloses, and all in a scene."""
    limits: HoleConfig = HoleConfig()
    """Limits of holes; `kind` chooses their kind in place of its own."""

    def find_up(self, scene: Gaussians, renderer: Renderer) -> Upward:
        """Find the upward direction: as named, or else also by the cameras beside the splat."""
        splat = self.reading.folder
        # Where up is named, cameras beside the splat are not needed, and may be damaged.
        beside = find_cameras_beside(splat) if self.up is None else None
        cameras = [] if beside is None else load_cameras(beside, self.reading.resolution)
        return find_upward(splat, scene, renderer, self.up, cameras)


@dataclass(frozen=True)
class Capture:
    """Cameras at which the splat can be rendered in place of photographs."""

    cameras: Sequence[Camera]
    names: Sequence[str]
    """Their names as photographs, which the user sees and may give."""
    source: CaptureSource
    where: str
    """Words that say which cameras they are, and follow that word."""
    more: str
    """Words on what else could be given, from a semicolon on; empty if the user named them."""
    upward: Upward | None = None
    """What is up for them; None for cameras that are not placed by it."""
    others: Sequence[Camera] = ()
    """Further cameras from which the splat looks well, and at which it is not rendered."""


def take_from_file(path: Path, known: Photographs, request: RenderRequest) -> Capture:
    """Take all cameras of the file `path`, which `known` holds relative to its origin."""
    where = f"of {quote_value(path)}"
    more = ""
    if request.cameras is None:
        where += ", which was found beside the splat,"
        more = "; --cameras names another file"
    cameras = [known.camera(number, request.reading.resolution) for number in range(len(known))]
    names = [frame.file_name for frame in known.frames]
    return Capture(cameras, names, "cameras", where, more)


def find_cameras_alone(
    scene: Gaussians,
    pixel_center: Float[Tensor, "3"] | None,
    renderer: Renderer,
    request: RenderRequest,
) -> Capture:
    """Find cameras by the splat alone.

    That of a pixel-aligned splat is taken with small moves of it. It stands at `pixel_center`, in
    the frame of `scene`; None for a trained splat, which tells no more than from where it looks
    well.

    Raises:
        InputError: The camera of a pixel-aligned splat sees too little of it, or a trained splat
            looks like a photograph from nowhere.
    """
    upward = request.find_up(scene, renderer)
    if pixel_center is None:
        return find_standing_cameras(scene, renderer, upward, request)
    # Each pixel made a Gaussian, and two photographs are the fewest that make such a splat: none
    # had more pixels than half of the Gaussians.
    side = max(MIN_FOUND_SIDE, round((len(scene) / 2) ** 0.5))
    if request.reading.resolution is not None:
        side = min(side, choose_side(request.reading.resolution))
    camera = aim_pixel_camera(scene, pixel_center, upward.direction, side)
    ranged = add_near_plane(camera, scene.means)
    seen = renderer.render(scene, ranged).depth_map()
    covered = seen.valid.float().mean().item()
    if covered < MIN_FOUND_COVERED:
        raise InputError(
            f"The camera that fits the splat sees it in {covered:.1%} of its image, and at least "
            f"{MIN_FOUND_COVERED:.0%} are needed to trust it; name a camera with --target, or the "
            "cameras it was made from with --cameras."
        )
    cameras = move_beside(camera, seen.depth[seen.valid].median().item())
    where = "that follow from the sizes of its Gaussians"
    return name_capture(cameras, "pixels", where, request, upward)


def find_standing_cameras(
    scene: Gaussians, renderer: Renderer, upward: Upward, request: RenderRequest
) -> Capture:
    """Find cameras from which a trained splat looks like a photograph; InputError for none."""
    side = choose_side(request.reading.resolution)
    cameras = find_standpoints(scene, upward.direction, side, renderer, MAX_WITNESSES)
    if not cameras:
        raise InputError(
            "There is no place from which the splat looks like a photograph; name its cameras with "
            "--cameras, or which way is up with --up."
        )
    best = cameras[:NUM_STANDPOINTS]
    where = "from which it looks like a photograph"
    found = name_capture(best, "standpoints", where, request, upward)
    return replace(found, others=cameras[NUM_STANDPOINTS:])


def search_around_place(
    scene: Gaussians,
    origin: Float[np.ndarray, "3"],
    renderer: Renderer,
    request: RenderRequest,
) -> Capture:
    """Search for cameras around what is to be removed.

    `scene` is relative to `origin`, which is in the coordinates of the file. InputError is raised
    if nothing is selected, or no camera sees it.
    """
    assert request.place is not None
    chosen = select_without_masks(request.place, scene, origin)
    upward = request.find_up(scene, renderer)
    side = choose_side(request.reading.resolution)
    cameras = choose_cameras_around_place(scene, chosen, upward.direction, side, renderer)
    where = "around what is removed"
    # They look at the place alone. What stands behind it, and is hidden from all of them, may be
    # what photographs of the scene show.
    beside = find_cameras_beside(request.reading.folder)
    if beside is not None:
        listed = select_listed_cameras(beside, scene.means[chosen], origin, side)
        where += f", and {len(listed)} of {quote_value(beside)}," if listed else ""
        cameras = [*cameras, *listed]
    if not cameras:
        raise InputError(
            "No camera around what is to be removed sees it unhidden; name cameras with --cameras, "
            "or which way is up with --up."
        )
    return name_capture(cameras, "place", where, request, upward)


def select_listed_cameras(
    path: Path, place: Float[Tensor, "n 3"], origin: Float[np.ndarray, "3"], side: int
) -> list[Camera]:
    """Select cameras of a list that see a place, far from each other.

    `place` are points relative to `origin`, and `side` is the longer side of an image at most.
    Nobody named the list, so that there are none if it cannot be read.
    """
    try:
        known = load_cameras(path, origin=origin.tolist())
    except InputError:
        return []
    seeing = []
    for camera in known:
        pixels, z = project(place, camera.to(place.device))
        if is_inside(pixels, z, camera).float().mean().item() >= MIN_SEEN_PLACE:
            seeing.append(shrink_camera(camera, side))
    if not seeing:
        return []
    return [seeing[index] for index in select_spread_cameras(seeing, MAX_LISTED_CAMERAS)]


def choose_side(resolution: tuple[int, int] | int | None) -> int:
    """Choose the width and height of the square cameras that are found, in pixels.

    They are the largest square in the size that was asked for: height and width, or the longer
    side. A trained splat has no full size, for which None stands: they then have the usual one.
    """
    if resolution is None:
        return DEFAULT_LONG_SIDE
    return resolution if isinstance(resolution, int) else min(resolution)


def search_around(
    targets: Sequence[Camera],
    holes: Sequence[Bool[Tensor, "h w"]],
    scene: Gaussians,
    renderer: Renderer,
    request: RenderRequest,
) -> Capture:
    """Search for cameras around the holes of all targets; InputError for none."""
    # Fewer around each of many targets, and one at least.
    count = max(1, min(MAX_CHOSEN_CAMERAS, MAX_AROUND // max(len(targets), 1)))
    cameras: list[Camera] = []
    for target, hole in zip(targets, holes, strict=True):
        for camera in choose_cameras_around(scene, target, renderer, hole, count):
            if not any(is_same_camera(camera, other) for other in cameras):
                cameras.append(camera)
    if not cameras:
        raise InputError(
            "No camera around the targets sees what surrounds their holes; move them closer to the "
            "scene, or name cameras with --cameras.",
            "target",
        )
    where = "found around the targets"
    return name_capture(cameras, "targets", where, request)


def name_capture(
    cameras: Sequence[Camera],
    source: CaptureSource,
    where: str,
    request: RenderRequest,
    upward: Upward | None = None,
) -> Capture:
    """Name cameras that were found, and give them the depth range that was asked for."""
    reading = request.reading
    ranged = [replace(camera, near=reading.near, far=reading.far) for camera in cameras]
    names = [name_render(number) for number in range(1, len(cameras) + 1)]
    return Capture(ranged, names, source, where, "; --cameras names others", upward)


def describe_capture(capture: Capture, num_chosen: int) -> str:
    """Write the sentence on the cameras whose renders take the place of photographs."""
    total = len(capture.cameras)
    count = f"{total}" if num_chosen == total else f"{num_chosen} of the {total}"
    noun = "camera" if total == 1 else "cameras"
    return (
        f"There are no photographs: renders of the splat at {count} {noun} {capture.where} take "
        f"their place{capture.more}."
    )
