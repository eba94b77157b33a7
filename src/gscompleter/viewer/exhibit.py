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
from gscompleter.data.framing import Resolution
from gscompleter.data.origin import frame_from_photographs
from gscompleter.data.scene import load_cameras
from gscompleter.data.structure_from_motion import POSES
from gscompleter.errors import InputError, quoted
from gscompleter.frames.similarity import moved_camera
from gscompleter.io.files import COMPLETED, CONTEXT, SUMMARY, TARGETS
from gscompleter.io.image import jpeg_of, read_pixels
from gscompleter.io.json_file import read_json
from gscompleter.io.ply import note_infinite_opacities
from gscompleter.splats.formats import load_splat
from gscompleter.splats.sog import META
from gscompleter.types import Camera, Gaussians

THUMBNAIL_SIDE = 160
"""Longer side of a thumbnail in pixels, shown at half size on fine screens."""
THUMBNAIL_QUALITY = 80
"""JPEG quality of a thumbnail."""


Summary = Mapping[str, Any]
"""Content of `summary.json`."""


@dataclass(frozen=True)
class Shot:
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
class Place:
    """Transform from the frame of given cameras to that of a scene."""

    origin: Float[np.ndarray, "3"]
    """Subtracted from camera positions in float64, before rounding."""
    transform: Float[np.ndarray, "4 4"]
    """Applied afterwards."""


SAME = Place(np.zeros(3), np.eye(4))
"""Transform of cameras in the frame of the scene."""


@dataclass(frozen=True)
class Exhibit:
    """Two states of a scene in one frame, with cameras."""

    title: str
    after: Gaussians
    before: Gaussians | None
    """The other state, or None to show one only."""
    shots: tuple[Shot, ...] = ()
    remarks: tuple[str, ...] = ()
    """Sentences on missing or changed content."""
    place: Place = SAME
    """Frame of further cameras."""


def exhibit_of_files(after: Path, before: Path | None, drop_nonfinite: bool) -> Exhibit:
    """Load a splat to compare with `before`, or with its observed part if that is None."""
    scene = load_splat(after, drop_nonfinite)
    note = note_infinite_opacities(scene)
    remarks = () if note is None else (note,)
    if before is not None:
        return Exhibit(after.name, scene, load_splat(before, drop_nonfinite), remarks=remarks)
    given = scene[scene.generated == 0]
    shown = given if 0 < len(given) < len(scene) else None
    return Exhibit(after.name, scene, shown, remarks=remarks)


def is_completion(path: Path) -> bool:
    """Return True if `path` is a folder, but not that of a .sog."""
    return path.is_dir() and not (path / META).is_file()


def exhibit_of_completion(folder: Path, drop_nonfinite: bool) -> Exhibit:
    """Load an output folder of `complete`, with target and context cameras.

    Raises:
        InputError: The folder is no output of `complete`, or a file cannot be read.
    """
    missing = [name for name in (COMPLETED, CONTEXT, SUMMARY) if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"{quoted(folder)} has no {missing[0]}; name a folder that a completion was written "
            "to, or a file of Gaussians."
        )
    before, after = (load_splat(folder / name, drop_nonfinite) for name in (CONTEXT, COMPLETED))
    summary = summary_in(folder)
    place = place_of_completion(folder, summary)
    targets, remarks = target_shots(folder, summary, place), []
    try:
        photographs = context_shots(folder, summary, place)
    except InputError:
        photographs, remarks = (), [_lost(source_of(folder, summary))]
    name = folder.resolve().name
    return Exhibit(name, after, before, (*targets, *photographs), tuple(remarks), place)


def summary_in(folder: Path) -> Summary:
    """Read the summary of a completion."""
    content = read_json(folder / SUMMARY, "complete the scene again")
    return content if isinstance(content, dict) else {}


def target_shots(folder: Path, summary: Summary, place: Place) -> tuple[Shot, ...]:
    """Load the targets of a completion, with thumbnails of the result; may be empty."""
    if not (folder / TARGETS).is_file():
        return ()
    notes = notes_of(summary)
    cameras = load_cameras(folder / TARGETS, origin=place.origin.tolist())
    return tuple(
        Shot(
            f"target-{number}",
            f"Target {number}",
            moved_camera(camera, place.transform),
            thumbnail_of(folder / "images" / f"target{number}_after.png"),
            notes[number - 1] if number <= len(notes) else (),
        )
        for number, camera in enumerate(cameras, start=1)
    )


def context_shots(folder: Path, summary: Summary, place: Place) -> tuple[Shot, ...]:
    """Load the photographs of a completion's context; InputError if they were moved."""
    rows, format = summary.get("context"), _part(summary, "settings").get("format")
    photographs = open_photographs(source_of(folder, summary), format)
    transform = place.transform @ frame_from_photographs(place.origin - photographs.origin)
    frames = [row["frame"] for row in rows or () if isinstance(row, dict) and "frame" in row]
    return tuple(
        Shot(
            f"photograph-{number}",
            f"Photograph {number}",
            moved_camera(photographs.camera(number), transform),
            thumbnail_in(photographs.frame(number)),
        )
        for number in frames
    )


def source_of(folder: Path, summary: Summary) -> Path:
    """Locate the photographs of a completion; in `folder` itself if their poses were computed."""
    if _part(summary, "scene").get("format") == "photographs":
        return folder / POSES
    return Path(str(_part(summary, "settings").get("folder")))


def camera_shots(path: Path, resolution: Resolution, place: Place) -> tuple[Shot, ...]:
    """Load the cameras of a file, with thumbnails of photographs that exist.

    `resolution` is used if the file states no size; `place` leads from its frame to the scene's.
    """
    frames = read_cameras(path, resolution)
    cameras = load_cameras(path, resolution, origin=place.origin.tolist())
    return tuple(
        Shot(
            f"camera-{number}",
            Path(frame.name).name or f"Camera {number}",
            moved_camera(camera, place.transform),
            thumbnail_in(frame),
        )
        for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True), start=1)
    )


def place_of_completion(folder: Path, summary: Summary) -> Place:
    """Read the transform from the photographs' frame to that of a completion's scenes."""
    frame = _part(summary, "frame")
    transform, origin = _numbers(frame.get("transform"), 4, 4), _numbers(frame.get("origin"), 3)
    if transform is None or origin is None or np.linalg.det(transform) <= 0:
        raise InputError(
            f"{quoted(folder / SUMMARY)} has no `frame` with a `transform` of 4 x 4 numbers and an "
            "`origin`; complete the scene again."
        )
    return Place(origin, transform @ frame_from_photographs(-origin))


def notes_of(summary: Summary) -> list[tuple[str, ...]]:
    """Collect the notes on each target of a completion."""
    targets = summary.get("targets")
    rows = targets if isinstance(targets, list) else []
    notes = [row.get("notes") if isinstance(row, dict) else None for row in rows]
    return [tuple(map(str, row)) if isinstance(row, list) else () for row in notes]


def thumbnail_in(frame: Frame) -> bytes | None:
    """Make a thumbnail of a frame's photograph; None if it is not in a file."""
    stored = frame.stored()
    return thumbnail_of(stored) if isinstance(stored, Path) else None


def thumbnail_of(path: Path) -> bytes | None:
    """Make a small JPEG of an image file; None if there is no file."""
    if not path.is_file():
        return None
    image = Image.fromarray(read_pixels(path))
    image.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    return jpeg_of(image, THUMBNAIL_QUALITY)


def _lost(source: Path) -> str:
    return (
        f"The context photographs are not shown: {quoted(source)} does not hold them any more; "
        "restore them, or name their cameras."
    )


def _numbers(value: Any, *shape: int) -> Float[np.ndarray, "..."] | None:
    """Convert `value` to an array of finite numbers of the given shape, or return None."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array if array.shape == shape and np.isfinite(array).all() else None


def _part(content: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    part = content.get(name)
    return part if isinstance(part, dict) else {}
