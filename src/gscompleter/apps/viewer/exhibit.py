"""Content of a viewer page: a scene before and after, and cameras to jump to."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float
from PIL import Image

from gscompleter.apps.report.schema import (
    CompletionSummary,
    ResultFrame,
    find_completed,
    read_summary,
)
from gscompleter.data.camera_files import read_cameras
from gscompleter.data.formats import open_photographs
from gscompleter.data.frame import Frame
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.photograph_names import name_photograph
from gscompleter.data.photographs import Resolution
from gscompleter.data.scene import load_cameras
from gscompleter.data.sfm.refined_file import take_refined
from gscompleter.splats.alignment.similarity import transform_camera
from gscompleter.splats.formats import load_splat
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import encode_jpeg, read_pixels, turn_upright
from gscompleter.system.files.output_folder import FOUND_POSES_FOLDER
from gscompleter.system.files.result_names import (
    CONTEXT_FILE,
    REFINED_POSES_FILE,
    RENDERS_FILE,
    TARGETS_FILE,
)
from gscompleter.types import Camera, Gaussians

THUMBNAIL_SIDE = 160
"""Longer side of a thumbnail, in pixels."""
THUMBNAIL_QUALITY = 80
"""JPEG quality of a thumbnail."""


@dataclass(frozen=True)
class ViewerCamera:
    """A camera to jump to."""

    name: str
    """Unique name in links, such as `target-6`."""
    title: str
    camera: Camera
    """In the frame of the scene."""
    thumbnail: bytes | None = None
    notes: tuple[str, ...] = ()
    has_frame: bool = True
    """False for a camera of no photograph or target, with which the whole window is filled."""


@dataclass(frozen=True)
class ViewerContent:
    """Two states of a scene in one frame, with cameras."""

    title: str
    after: Gaussians
    before: Gaussians | None
    """The other state, or None to show one only."""
    cameras: tuple[ViewerCamera, ...] = ()
    notes: tuple[str, ...] = ()
    up: tuple[float, float, float] | None = None
    """Upward direction in the frame of the scene; None for that of most cameras."""
    transform: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Similarity from the frame of further cameras to that of the scene."""
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Subtracted from positions of such cameras in float64, before rounding."""


def load_scene_cameras(
    path: Path,
    transform: Float[np.ndarray, "4 4"],
    origin: Float[np.ndarray, "3"],
    resolution: Resolution = None,
) -> list[Camera]:
    """Load the cameras of a file into the frame of a scene; arguments as in `ViewerContent`."""
    cameras = load_cameras(path, resolution, origin=origin.tolist())
    return [move_scene_camera(camera, transform, origin) for camera in cameras]


def move_scene_camera(
    camera: Camera, transform: Float[np.ndarray, "4 4"], origin: Float[np.ndarray, "3"]
) -> Camera:
    """Move a camera that was read relative to `origin` into the frame of a scene."""
    # The origin was taken off in float64, and is moved back by the transform.
    return transform_camera(camera, transform @ compute_frame_from_photographs(-origin))


def load_viewer_files(
    after: Path, before: Path | None, drop_nonfinite: bool, ignore_properties: bool = False
) -> ViewerContent:
    """Load a splat to compare with `before`, or with its observed part if that is None.

    What later commands added from photographs, which has a label, is no part of the observed one.
    """
    scene = load_splat(after, drop_nonfinite, ignore_properties)
    if before is not None:
        other = load_splat(before, drop_nonfinite, ignore_properties).move_origin(scene.origin)
        return place_content(ViewerContent(after.name, scene, other))
    is_observed = scene.generated == 0
    # Without anything generated or anything observed there is only one state to show.
    has_two_states = bool(is_observed.any()) and not bool(is_observed.all())
    before_that = scene[is_observed] if has_two_states else None
    return place_content(ViewerContent(after.name, scene, before_that))


def place_content(content: ViewerContent, frame: ResultFrame | None = None) -> ViewerContent:
    """Set the `transform` and `origin` that lead cameras of files to the frame of the scene.

    Such cameras are in the frame of the splat's file, or for a completion in that of its
    photographs, from which `frame` leads to that of the file.
    """
    origin = np.array(content.after.origin or (0.0, 0.0, 0.0))
    transform = compute_frame_from_photographs(origin)
    if frame is not None:
        transform = transform @ np.array(frame.transform)
    # The place of the zero of the scene in the frame of the cameras: those of its photographs are
    # near it, however large the coordinates of their map are.
    zero = np.linalg.solve(transform[:3, :3], -transform[:3, 3])
    return replace(content, transform=transform, origin=zero)


def load_viewer_completion(folder: Path, drop_nonfinite: bool) -> ViewerContent:
    """Load an output folder of `complete`, with target and context cameras."""
    summary = read_summary(folder)
    # What is shown was completed as it is, whatever further properties it has.
    after = load_splat(find_completed(folder), drop_nonfinite, ignore_properties=True)
    before = None
    scene_notes: tuple[str, ...] = ()
    # With `--save-as` the input splat is the scene before, and stays where the user has it.
    context = Path(summary.scene.context or folder / CONTEXT_FILE)
    if os.path.exists(context):
        before = load_splat(context, drop_nonfinite, ignore_properties=True)
        before = before.move_origin(after.origin)
    else:
        scene_notes = (
            f"The scene before is not shown, because {quote_value(context)} is not there any more.",
        )
    content = place_content(ViewerContent(folder.resolve().name, after, before), summary.frame)
    cameras, camera_notes = load_known_cameras(folder, summary, content)
    return replace(content, cameras=cameras, notes=(*scene_notes, *camera_notes))


def load_known_cameras(
    folder: Path, summary: CompletionSummary, content: ViewerContent
) -> tuple[tuple[ViewerCamera, ...], tuple[str, ...]]:
    """Load the targets and the photographs of a completion, with notes on what is missing.

    Without photographs that can be read, the notes say why they are not shown.
    """
    targets = load_target_cameras(folder, summary, content)
    if summary.scene.renders_from is not None:
        return (*targets, *load_render_cameras(folder, summary, content)), ()
    given = summary.settings.get("folder")
    if given is None:
        # `Completion.save` got its photographs as values, which have no file.
        return targets, (
            "The context photographs are not shown, because no folder of them is known.",
        )
    # The poses of photographs that had none lie in the output folder; others stay where the user
    # has them.
    is_posed_by_us = summary.scene.format == "photographs"
    source = folder / FOUND_POSES_FOLDER if is_posed_by_us else Path(str(given))
    if not os.path.exists(source):  # also for names that no file can have
        # A path is as the command was given it, and leads elsewhere from another folder.
        cause = "is not in this folder, and was named from another"
        if source.is_absolute():
            cause = "was moved"
        note = f"The context photographs are not shown, because {quote_value(source)} {cause}."
        return targets, (note,)
    try:
        photographs = load_context_cameras(folder, source, summary, content)
    except InputError as error:
        return targets, (f"The context photographs are not shown. {error}",)
    return (*targets, *photographs), ()


def load_target_cameras(
    folder: Path, summary: CompletionSummary, content: ViewerContent
) -> tuple[ViewerCamera, ...]:
    """Load the targets of a completion, with thumbnails of the result; may be empty."""
    if not (folder / TARGETS_FILE).is_file():
        return ()
    cameras = load_scene_cameras(folder / TARGETS_FILE, content.transform, content.origin)
    return tuple(
        ViewerCamera(
            f"target-{number}",
            f"Target {number}: {row.name}",
            camera,
            make_thumbnail(folder / "images" / f"target{number}_after.png"),
            row.notes,
        )
        for number, (camera, row) in enumerate(zip(cameras, summary.targets, strict=False), 1)
    )


def load_render_cameras(
    folder: Path, summary: CompletionSummary, content: ViewerContent
) -> tuple[ViewerCamera, ...]:
    """Load the cameras of renders that took the place of photographs, with thumbnails."""
    cameras = load_scene_cameras(folder / RENDERS_FILE, content.transform, content.origin)
    return tuple(
        ViewerCamera(
            f"photograph-{row.frame}",
            f"View {row.photograph}",
            camera,
            make_thumbnail(folder / "images" / f"context{number}_render.png"),
        )
        for number, (camera, row) in enumerate(zip(cameras, summary.context, strict=False), 1)
    )


def load_context_cameras(
    folder: Path, source: Path, summary: CompletionSummary, content: ViewerContent
) -> tuple[ViewerCamera, ...]:
    """Load the photographs of a completion's context, with the poses that it used.

    `source` is the scene of the photographs. Raises InputError if one of them cannot be read, or is
    not in it any more.
    """
    name = summary.settings.get("format")
    photographs = open_photographs(source, None if name is None else str(name))
    refined = folder / REFINED_POSES_FILE
    if summary.scene.refined_poses is not None and refined.is_file():
        taken = take_refined(photographs, refined)
        photographs = photographs if taken is None else taken[0]
    return tuple(
        ViewerCamera(
            f"photograph-{number}",
            f"Photograph {name_photograph(number, photographs.frame(number).file_name)}",
            move_scene_camera(photographs.camera(number), content.transform, photographs.origin),
            make_frame_thumbnail(photographs.frame(number)),
        )
        for number in [row.frame for row in summary.context if row.frame is not None]
    )


def add_file_cameras(content: ViewerContent, path: Path, resolution: Resolution) -> ViewerContent:
    """Add the cameras of a file, with thumbnails of photographs that exist."""
    cameras = load_scene_cameras(path, content.transform, content.origin, resolution)
    frames = read_cameras(path, resolution)
    shots = [
        ViewerCamera(
            f"camera-{number}",
            PurePosixPath(frame.file_name).name or f"Camera {number}",
            camera,
            make_frame_thumbnail(frame),
        )
        for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True), start=1)
    ]
    return replace(content, cameras=(*content.cameras, *shots))


def make_frame_thumbnail(frame: Frame) -> bytes | None:
    """Make a small JPEG of the upright photograph of a frame; None if it is no file."""
    file = frame.file
    if file is None or file.path is None:
        return None
    return make_thumbnail(file.path, file.orientation if file.is_turned else frame.find_turn())


def make_thumbnail(stored: Path, orientation: int = 1) -> bytes | None:
    """Make a small JPEG of an image file that EXIF turns; None if there is no file."""
    if not stored.is_file():
        return None
    return shrink_image(Image.fromarray(turn_upright(read_pixels(stored), orientation)))


def shrink_image(image: Image.Image) -> bytes:
    """Make a small JPEG of an image, which shrinks itself."""
    image.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    return encode_jpeg(image, THUMBNAIL_QUALITY)
