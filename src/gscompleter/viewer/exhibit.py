"""What a page shows: a scene before and after, and cameras that one can jump to."""

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
"""Pixels of the longer side of a thumbnail, which is shown at half of that on fine screens."""
THUMBNAIL_QUALITY = 80
"""Of the JPEG that a thumbnail is."""


Summary = Mapping[str, Any]
"""What lies in `summary.json`, whatever that is."""


@dataclass(frozen=True)
class Shot:
    """A camera that one can jump to."""

    name: str
    """What a link calls it, such as `target-6`; no two have the same."""
    title: str
    camera: Camera
    """In the frame of the scene."""
    thumbnail: bytes | None = None
    """A small JPEG of what it shows."""
    notes: tuple[str, ...] = ()
    """What there is to say of it."""


@dataclass(frozen=True)
class Place:
    """Where the frame that cameras are given in lies in that of a scene."""

    origin: Float[np.ndarray, "3"]
    """What is subtracted from their positions in float64, before anything is rounded."""
    transform: Float[np.ndarray, "4 4"]
    """From what is left to the frame of the scene."""


SAME = Place(np.zeros(3), np.eye(4))
"""Of cameras in the frame of the scene."""


@dataclass(frozen=True)
class Exhibit:
    """Two states of a scene in one frame, and where to look at them from."""

    title: str
    after: Gaussians
    before: Gaussians | None
    """None where there is nothing to compare with."""
    shots: tuple[Shot, ...] = ()
    remarks: tuple[str, ...] = ()
    """Notes on what is missing of it, or not as in its file, a sentence each."""
    place: Place = SAME
    """Where the frame lies that further cameras are given in."""


def exhibit_of_files(after: Path, before: Path | None, drop_nonfinite: bool) -> Exhibit:
    """A scene beside another, or beside itself without what was generated.

    Args:
        after: A file of Gaussians in any format that is known.
        before: Another one in the same frame; None for what was observed of `after`.
        drop_nonfinite: Leave out Gaussians that hold NaN or infinity.

    Raises:
        InputError: where a file cannot be read.
    """
    scene = load_splat(after, drop_nonfinite)
    note = note_infinite_opacities(scene)
    remarks = () if note is None else (note,)
    if before is not None:
        return Exhibit(after.name, scene, load_splat(before, drop_nonfinite), remarks=remarks)
    given = scene[scene.generated == 0]
    shown = given if 0 < len(given) < len(scene) else None
    return Exhibit(after.name, scene, shown, remarks=remarks)


def is_completion(path: Path) -> bool:
    """Whether `path` is a folder, and no scene that is one (a .sog)."""
    return path.is_dir() and not (path / META).is_file()


def exhibit_of_completion(folder: Path, drop_nonfinite: bool) -> Exhibit:
    """What `complete` left in a folder, with its targets and the photographs of its context.

    Raises:
        InputError: where the folder is not one of `complete`, or a file cannot be read.
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
    """What a completion said of itself.

    Raises:
        InputError: where the file cannot be read.
    """
    content = read_json(folder / SUMMARY, "complete the scene again")
    return content if isinstance(content, dict) else {}


def target_shots(folder: Path, summary: Summary, place: Place) -> tuple[Shot, ...]:
    """The targets of a completion, with their pictures after it; none where it had none.

    Raises:
        InputError: where a file cannot be read.
    """
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
    """Show the photographs that the completion in `folder` began with.

    Raises:
        InputError: where they are no more where they were, or cannot be read.
    """
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
    """Locate the posed photographs that the completion in `folder` began with: in that folder where
    their cameras had to be found."""
    if _part(summary, "scene").get("format") == "photographs":
        return folder / POSES
    return Path(str(_part(summary, "settings").get("folder")))


def camera_shots(path: Path, resolution: Resolution, place: Place) -> tuple[Shot, ...]:
    """The cameras of a file, with their photographs where these lie there.

    Args:
        path: As `load_cameras` takes it.
        resolution: Of images whose size the file does not tell.
        place: Where the frame of the file lies in that of the scene.

    Raises:
        InputError: where the file or one of its cameras is missing or impossible.
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
    """Where the photographs' frame lies in that of a completion's scenes.

    Raises:
        InputError: where the summary does not tell it.
    """
    frame = _part(summary, "frame")
    transform, origin = _numbers(frame.get("transform"), 4, 4), _numbers(frame.get("origin"), 3)
    if transform is None or origin is None or np.linalg.det(transform) <= 0:
        raise InputError(
            f"{quoted(folder / SUMMARY)} has no `frame` with a `transform` of 4 x 4 numbers and an "
            "`origin`; complete the scene again."
        )
    return Place(origin, transform @ frame_from_photographs(-origin))


def notes_of(summary: Summary) -> list[tuple[str, ...]]:
    """What a completion said of each of its targets."""
    targets = summary.get("targets")
    rows = targets if isinstance(targets, list) else []
    notes = [row.get("notes") if isinstance(row, dict) else None for row in rows]
    return [tuple(map(str, said)) if isinstance(said, list) else () for said in notes]


def thumbnail_in(frame: Frame) -> bytes | None:
    """A small JPEG of a frame's photograph; None where none lies in a file."""
    stored = frame.stored()
    return thumbnail_of(stored) if isinstance(stored, Path) else None


def thumbnail_of(path: Path) -> bytes | None:
    """A small JPEG of an image file; None where there is no such file.

    Raises:
        InputError: where there is one that cannot be read.
    """
    if not path.is_file():
        return None
    image = Image.fromarray(read_pixels(path))
    image.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    return jpeg_of(image, THUMBNAIL_QUALITY)


def _lost(source: Path) -> str:
    return (
        f"The photographs that the completion began with are not shown: {quoted(source)} does not "
        "hold them any more; name their cameras to jump to them."
    )


def _numbers(value: Any, *shape: int) -> Float[np.ndarray, "..."] | None:
    """An array of finite numbers of that shape, if `value` is one."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array if array.shape == shape and np.isfinite(array).all() else None


def _part(content: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    part = content.get(name)
    return part if isinstance(part, dict) else {}
