"""`holes.json`: the cameras whose holes were exported to be painted elsewhere.

Its cameras have the keys of nerfstudio's `transforms.json`, so that `--target` reads them. There is
no `file_path`: readers would take the size of a painted image for that of its camera.
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


@dataclass(frozen=True)
class HoleRow:
    """A target whose hole was exported; its files lie beside `holes.json`.

    The keys of its camera are read by `load_cameras`.
    """

    image_path: str
    """Image as the scene shows it, which is to be painted."""
    sha256: str
    """Checksum of that file, by which a painted one is told from it."""
    hole_mask_path: str
    """White where to paint."""
    w: int
    h: int
    hole_fraction: float
    frame: int | None = None
    """Frame of the photograph that the target is; None for another camera."""
    derived_from: int | None = None
    """Frame that a planned camera was derived from; None for another camera, and for a render whose
    camera was found, since that has another number in the next command."""
    offset: str | None = None
    """Move and turn from that frame, in words."""
    path_frame: int | None = None
    """Frame of the video at which the camera stands here, from 0; None if it never does."""
    title: str = ""
    """Name of the target for people (`name_target`)."""


@dataclass(frozen=True)
class PathRow:
    """A video along the targets."""

    video_path: str
    sha256: str
    num_frames: int


@dataclass(frozen=True)
class HolesFile:
    """The part of `holes.json` that is read besides the cameras."""

    version: str
    context: tuple[int, ...]
    """Frames of the context, from which the scene was made; none for renders of a splat alone whose
    cameras were found."""
    frames: tuple[HoleRow, ...]
    path: PathRow | None = None


def has_holes(folder: Path) -> bool:
    """Check whether a folder has a `holes.json`."""
    return os.path.isfile(folder / HOLES_FILE)


def read_holes(folder: Path) -> HolesFile:
    """Read and validate the `holes.json` of a folder."""
    path = folder / HOLES_FILE
    holes = read_typed_json(HolesFile, path, HOLES_ADVICE)
    if not holes.frames:
        raise InputError(f"{quote_value(path)} lists no frames; {HOLES_ADVICE}.")
    # What is read lies in the folder itself, whatever the file says.
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
                f"{quote_value(path)} names frame {row.path_frame} of a video with {num_frames}; "
                f"{HOLES_ADVICE}."
            )
    return holes


def list_hole_files(holes: HolesFile) -> Iterator[str]:
    """List the files that are read."""
    for row in holes.frames:
        yield from (row.image_path, row.hole_mask_path)
    if holes.path is not None:
        yield holes.path.video_path
