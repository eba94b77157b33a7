"""Content of a viewer page: a scene before and after, and cameras to jump to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from gscompleter.data.camera_files import read_cameras
from gscompleter.data.formats import open_photographs
from gscompleter.data.frame import Frame
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.resize import Resolution
from gscompleter.data.scene import load_cameras
from gscompleter.data.sfm.poses import POSES
from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import COMPLETED_FILE, CONTEXT_FILE, SUMMARY_FILE, TARGETS_FILE
from gscompleter.io.image import encode_jpeg, read_pixels
from gscompleter.io.json_file import read_json
from gscompleter.splat_alignment.similarity import transform_camera
from gscompleter.splats.formats import load_splat, note_infinite_opacities
from gscompleter.splats.sog import META
from gscompleter.types import Camera, Gaussians

THUMBNAIL_SIDE = 160
"""Longer side of a thumbnail in pixels, shown at half size on fine screens."""
THUMBNAIL_QUALITY = 80
"""JPEG quality of a thumbnail."""


Summary = Mapping[str, Any]
"""Content of `summary.json`."""


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
    """Sentences on its completion."""


@dataclass(frozen=True)
class SceneTransform:
    """Transform from the frame of given cameras to that of a scene."""

    origin: Float[np.ndarray, "3"]
    """Subtracted from camera positions in float64, before rounding."""
    transform: Float[np.ndarray, "4 4"]
    """Applied afterwards."""


IDENTITY_TRANSFORM = SceneTransform(np.zeros(3), np.eye(4))
"""Transform of cameras in the frame of the scene."""


@dataclass(frozen=True)
class ViewerContent:
    """Two states of a scene in one frame, with cameras."""

    title: str
    after: Gaussians
    before: Gaussians | None
    """The other state, or None to show one only."""
    cameras: tuple[ViewerCamera, ...] = ()
    notes: tuple[str, ...] = ()
    """Sentences on missing or changed content."""
    scene_transform: SceneTransform = IDENTITY_TRANSFORM
    """Frame of further cameras."""


def load_viewer_files(after: Path, before: Path | None, drop_nonfinite: bool) -> ViewerContent:
    """Load a splat to compare with `before`, or with its observed part if that is None."""
    scene = load_splat(after, drop_nonfinite)
    note = note_infinite_opacities(scene)
    remarks = () if note is None else (note,)
    if before is not None:
        return ViewerContent(after.name, scene, load_splat(before, drop_nonfinite), notes=remarks)
    given = scene[scene.generated == 0]
    shown = given if 0 < len(given) < len(scene) else None
    return ViewerContent(after.name, scene, shown, notes=remarks)


def is_completion(path: Path) -> bool:
    """Return True if `path` is a folder, but not that of a .sog."""
    return path.is_dir() and not (path / META).is_file()


def load_viewer_completion(folder: Path, drop_nonfinite: bool) -> ViewerContent:
    """Load an output folder of `complete`, with target and context cameras.

    Raises:
        InputError: The folder is no output of `complete`, or a file cannot be read.
    """
    missing = [
        name
        for name in (COMPLETED_FILE, CONTEXT_FILE, SUMMARY_FILE)
        if not (folder / name).is_file()
    ]
    if missing:
        raise InputError(
            f"{quote_value(folder)} has no {missing[0]}; name a folder that a completion was "
            "written "
            "to, or a file of Gaussians."
        )
    before, after = (
        load_splat(folder / name, drop_nonfinite) for name in (CONTEXT_FILE, COMPLETED_FILE)
    )
    summary = load_summary(folder)
    place = read_scene_transform(folder, summary)
    targets, remarks = load_target_cameras(folder, summary, place), []
    try:
        photographs = load_context_cameras(folder, summary, place)
    except InputError:
        photographs, remarks = (
            (),
            [_describe_missing_photographs(locate_photographs(folder, summary))],
        )
    name = folder.resolve().name
    return ViewerContent(name, after, before, (*targets, *photographs), tuple(remarks), place)


def load_summary(folder: Path) -> Summary:
    """Read the summary of a completion."""
    content = read_json(folder / SUMMARY_FILE, "complete the scene again")
    return content if isinstance(content, dict) else {}


def load_target_cameras(
    folder: Path, summary: Summary, scene_transform: SceneTransform
) -> tuple[ViewerCamera, ...]:
    """Load the targets of a completion, with thumbnails of the result; may be empty."""
    if not (folder / TARGETS_FILE).is_file():
        return ()
    notes = collect_notes(summary)
    cameras = load_cameras(folder / TARGETS_FILE, origin=scene_transform.origin.tolist())
    return tuple(
        ViewerCamera(
            f"target-{number}",
            f"Target {number}",
            transform_camera(camera, scene_transform.transform),
            make_thumbnail(folder / "images" / f"target{number}_after.png"),
            notes[number - 1] if number <= len(notes) else (),
        )
        for number, camera in enumerate(cameras, start=1)
    )


def load_context_cameras(
    folder: Path, summary: Summary, scene_transform: SceneTransform
) -> tuple[ViewerCamera, ...]:
    """Load the photographs of a completion's context; InputError if they were moved."""
    rows, format = summary.get("context"), _get_table(summary, "settings").get("format")
    photographs = open_photographs(locate_photographs(folder, summary), format)
    transform = scene_transform.transform @ compute_frame_from_photographs(
        scene_transform.origin - photographs.origin
    )
    frames = [row["frame"] for row in rows or () if isinstance(row, dict) and "frame" in row]
    return tuple(
        ViewerCamera(
            f"photograph-{number}",
            f"Photograph {number}",
            transform_camera(photographs.camera(number), transform),
            make_frame_thumbnail(photographs.frame(number)),
        )
        for number in frames
    )


def locate_photographs(folder: Path, summary: Summary) -> Path:
    """Locate the photographs of a completion; in `folder` itself if their poses were computed."""
    if _get_table(summary, "scene").get("format") == "photographs":
        return folder / POSES
    return Path(str(_get_table(summary, "settings").get("folder")))


def load_file_cameras(
    path: Path, resolution: Resolution, scene_transform: SceneTransform
) -> tuple[ViewerCamera, ...]:
    """Load the cameras of a file, with thumbnails of photographs that exist.

    `resolution` is used if the file states no size; `place` leads from its frame to the scene's.
    """
    frames = read_cameras(path, resolution)
    cameras = load_cameras(path, resolution, origin=scene_transform.origin.tolist())
    return tuple(
        ViewerCamera(
            f"camera-{number}",
            Path(frame.name).name or f"Camera {number}",
            transform_camera(camera, scene_transform.transform),
            make_frame_thumbnail(frame),
        )
        for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True), start=1)
    )


def read_scene_transform(folder: Path, summary: Summary) -> SceneTransform:
    """Read the transform from the photographs' frame to that of a completion's scenes."""
    frame = _get_table(summary, "frame")
    transform, origin = (
        _parse_array(frame.get("transform"), 4, 4),
        _parse_array(frame.get("origin"), 3),
    )
    if transform is None or origin is None or np.linalg.det(transform) <= 0:
        raise InputError(
            f"{quote_value(folder / SUMMARY_FILE)} has no `frame` with a `transform` of 4 x 4 "
            "numbers and an "
            "`origin`; complete the scene again."
        )
    return SceneTransform(origin, transform @ compute_frame_from_photographs(-origin))


def collect_notes(summary: Summary) -> list[tuple[str, ...]]:
    """Collect the notes on each target of a completion."""
    targets = summary.get("targets")
    rows = targets if isinstance(targets, list) else []
    notes = [row.get("notes") if isinstance(row, dict) else None for row in rows]
    return [tuple(map(str, row)) if isinstance(row, list) else () for row in notes]


def make_frame_thumbnail(frame: Frame) -> bytes | None:
    """Make a thumbnail of a frame's photograph; None if it is not in a file."""
    stored = frame.find_stored()
    return make_thumbnail(stored) if isinstance(stored, Path) else None


def make_thumbnail(path: Path) -> bytes | None:
    """Make a small JPEG of an image file; None if there is no file."""
    if not path.is_file():
        return None
    image = Image.fromarray(read_pixels(path))
    image.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    return encode_jpeg(image, THUMBNAIL_QUALITY)


def _describe_missing_photographs(source: Path) -> str:
    return (
        f"The context photographs are not shown: {quote_value(source)} does not hold them any "
        "more; "
        "restore them, or name their cameras."
    )


def _parse_array(value: Any, *shape: int) -> Float[np.ndarray, "..."] | None:
    """Convert `value` to an array of finite numbers of the given shape, or return None."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array if array.shape == shape and np.isfinite(array).all() else None


def _get_table(content: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    part = content.get(name)
    return part if isinstance(part, dict) else {}
