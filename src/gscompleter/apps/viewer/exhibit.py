"""Content of a viewer page: a scene before and after, and cameras to jump to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from gscompleter.apps.report.schema import CompletionSummary, read_summary
from gscompleter.data.camera_files import read_cameras
from gscompleter.data.formats import open_photographs
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.resize import Resolution
from gscompleter.data.scene import load_cameras
from gscompleter.data.sfm.poses import POSES
from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import COMPLETED_FILE, CONTEXT_FILE, TARGETS_FILE
from gscompleter.io.image import encode_jpeg, read_pixels
from gscompleter.splat_alignment.similarity import transform_camera
from gscompleter.splats.formats import load_splat
from gscompleter.splats.sog import META
from gscompleter.types import Camera, Gaussians

THUMBNAIL_SIDE = 160
"""Longer side of a thumbnail in pixels, shown at half size on fine screens."""
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
    """Sentences on its completion."""


@dataclass(frozen=True)
class SceneTransform:
    """Transform from the frame of given cameras to that of a scene."""

    origin: Float[np.ndarray, "3"]
    """Subtracted from camera positions in float64, before rounding."""
    transform: Float[np.ndarray, "4 4"]
    """Applied to cameras relative to `origin`."""

    @classmethod
    def from_photographs(
        cls, transform: Float[np.ndarray, "4 4"], origin: Float[np.ndarray, "3"]
    ) -> SceneTransform:
        """Make the transform from the frame of the photographs, with a local origin."""
        return cls(origin, transform @ compute_frame_from_photographs(-origin))

    def load(self, path: Path, resolution: Resolution = None) -> list[Camera]:
        """Load the cameras of a file into the frame of the scene."""
        cameras = load_cameras(path, resolution, origin=self.origin.tolist())
        return [transform_camera(camera, self.transform) for camera in cameras]


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
    if before is not None:
        return ViewerContent(after.name, scene, load_splat(before, drop_nonfinite))
    given = scene[scene.generated == 0]
    shown = given if 0 < len(given) < len(scene) else None
    return ViewerContent(after.name, scene, shown)


def is_completion(path: Path) -> bool:
    """Return True if `path` is a folder, but not that of a .sog."""
    return path.is_dir() and not (path / META).is_file()


def load_viewer_completion(folder: Path, drop_nonfinite: bool) -> ViewerContent:
    """Load an output folder of `complete`, with target and context cameras.

    Raises:
        InputError: The folder is no output of `complete`, or a file cannot be read.
    """
    for name in (COMPLETED_FILE, CONTEXT_FILE):
        if not (folder / name).is_file():
            raise InputError(
                f"{quote_value(folder)} has no {name}; name a folder that a completion was written "
                "to, or a file of Gaussians."
            )
    before, after = (
        load_splat(folder / name, drop_nonfinite) for name in (CONTEXT_FILE, COMPLETED_FILE)
    )
    summary = read_summary(folder)
    transform, origin = np.array(summary.frame.transform), np.array(summary.frame.origin)
    place = SceneTransform.from_photographs(transform, origin)
    cameras, remarks = load_target_cameras(folder, summary, place), list[str]()
    source = locate_photographs(folder, summary)
    try:
        cameras += load_context_cameras(source, summary, place)
    except InputError:
        remarks.append(
            f"The context photographs are not shown: {quote_value(source)} does not hold them any "
            "more; restore them, or name their cameras."
        )
    name = folder.resolve().name
    return ViewerContent(name, after, before, tuple(cameras), tuple(remarks), place)


def load_target_cameras(
    folder: Path, summary: CompletionSummary, scene_transform: SceneTransform
) -> list[ViewerCamera]:
    """Load the targets of a completion, with thumbnails of the result; may be empty."""
    if not (folder / TARGETS_FILE).is_file():
        return []
    cameras = scene_transform.load(folder / TARGETS_FILE)
    return [
        ViewerCamera(
            f"target-{number}",
            f"Target {number}",
            camera,
            make_thumbnail(folder / "images" / f"target{number}_after.png"),
            row.notes,
        )
        for number, (camera, row) in enumerate(zip(cameras, summary.targets, strict=False), 1)
    ]


def load_context_cameras(
    source: Path, summary: CompletionSummary, scene_transform: SceneTransform
) -> list[ViewerCamera]:
    """Load the photographs of a completion's context; InputError if they were moved."""
    photographs = open_photographs(source, summary.settings.get("format"))
    transform = scene_transform.transform @ compute_frame_from_photographs(
        scene_transform.origin - photographs.origin
    )
    return [
        ViewerCamera(
            f"photograph-{number}",
            f"Photograph {number}",
            transform_camera(photographs.camera(number), transform),
            make_thumbnail(photographs.frame(number).find_stored()),
        )
        for number in [row.frame for row in summary.context if row.frame is not None]
    ]


def locate_photographs(folder: Path, summary: CompletionSummary) -> Path:
    """Locate the photographs of a completion; in `folder` itself if their poses were computed."""
    if summary.scene.format == "photographs":
        return folder / POSES
    return Path(str(summary.settings.get("folder")))


def load_file_cameras(
    path: Path, resolution: Resolution, scene_transform: SceneTransform
) -> list[ViewerCamera]:
    """Load the cameras of a file, with thumbnails of photographs that exist.

    `resolution` is used if the file states no size.
    """
    cameras = zip(
        read_cameras(path, resolution), scene_transform.load(path, resolution), strict=True
    )
    return [
        ViewerCamera(
            f"camera-{number}",
            Path(frame.name).name or f"Camera {number}",
            camera,
            make_thumbnail(frame.find_stored()),
        )
        for number, (frame, camera) in enumerate(cameras, start=1)
    ]


def make_thumbnail(stored: Path | bytes | None) -> bytes | None:
    """Make a small JPEG of an image file; None if there is no file."""
    if not isinstance(stored, Path) or not stored.is_file():
        return None
    image = Image.fromarray(read_pixels(stored))
    image.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    return encode_jpeg(image, THUMBNAIL_QUALITY)
