"""`holes.json`: the cameras whose holes were exported to be painted elsewhere.

Each entry of `frames` has the keys of a frame in nerfstudio's `transforms.json`, so that `--target`
reads its camera. It has no `file_path`: a reader would take the size of the painted image for that
of the camera. `docs/reference/painting.md` has the whole schema.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.typed_json import read_typed_json

HOLES_FILE = "holes.json"
HOLES_ADVICE = "export the holes again"
"""End of each sentence about a damaged file."""


@dataclass(frozen=True)
class HoleRow:
    """A target whose hole was exported; its files lie beside `holes.json`.

    `load_cameras` reads its camera from other keys of the same entry.
    """

    image_path: str
    """Image of the scene at the target, which is to be painted."""
    sha256: str
    """SHA-256 of that file in hexadecimal: a file with another one has been painted."""
    hole_mask_path: str
    """Image that is white where to paint."""
    w: int
    """Width of the image, in pixels."""
    h: int
    """Height of the image, in pixels."""
    hole_fraction: float
    """Share of the image that is a hole, in [0, 1]; the mask is somewhat larger."""
    frame: int | None = None
    """Frame of the photograph that the target is; None for another camera."""
    derived_from: int | None = None
    """Frame that a planned camera was derived from; None for a camera that was not planned. None,
    too, where renders at cameras that were found take the place of photographs: each run finds
    these anew, so that their numbers do not last."""
    offset: str | None = None
    """Move and turn from that frame, in words; None without one."""
    path_frame: int | None = None
    """Frame of the video, from 0, that shows this target; None without a video."""
    title: str = ""
    """Name of the target for people (`name_target`)."""


@dataclass(frozen=True)
class PathRow:
    """A video along the targets, which may be painted in place of their images."""

    video_path: str
    sha256: str
    """SHA-256 of that file in hexadecimal, as that of an image."""
    num_frames: int


@dataclass(frozen=True)
class HolesFile:
    """The part of `holes.json` that is read besides the cameras."""

    version: str
    """Version of gscompleter that wrote it."""
    context: tuple[int, ...]
    """Frames of the context; empty for renders at cameras that were found, whose numbers do not
    last."""
    frames: tuple[HoleRow, ...]
    """The targets, at least one."""
    path: PathRow | None = None


def has_holes(folder: Path) -> bool:
    """Return True if a folder has a `holes.json`; it may be damaged."""
    return os.path.isfile(folder / HOLES_FILE)


def read_holes(folder: Path) -> HolesFile:
    """Read and validate the `holes.json` of a folder.

    Raises:
        InputError: It is missing, damaged or of a later version, lists no target, names a file in
            another folder, or a frame that its video does not have.
    """
    path = folder / HOLES_FILE
    holes = read_typed_json(HolesFile, path, HOLES_ADVICE)
    if not holes.frames:
        raise InputError(f"{quote_value(path)} lists no frames; {HOLES_ADVICE}.")
    # It may come from somebody else, and must not lead to other files of the user.
    for name in list_hole_files(holes):
        if name != os.path.basename(name) or name in ("", ".", ".."):
            raise InputError(
                f"{quote_value(path)} names the file '{quote_value(name)}', and only files beside "
                f"it are read; {HOLES_ADVICE}."
            )
    num_frames = 0 if holes.path is None else holes.path.num_frames
    for row in holes.frames:
        if row.path_frame is not None and row.path_frame not in range(num_frames):
            raise InputError(
                f"{quote_value(path)} names frame {row.path_frame} of a video with {num_frames} "
                f"frames; {HOLES_ADVICE}."
            )
    return holes


def list_hole_files(holes: HolesFile) -> Iterator[str]:
    """List the names of files that `holes.json` leads to."""
    for row in holes.frames:
        yield from (row.image_path, row.hole_mask_path)
    if holes.path is not None:
        yield holes.path.video_path
