"""PandaSet sequences: a folder per camera with images, intrinsics and poses.

Poses are camera-to-world in OpenCV axes, as position and quaternion. Point clouds and boxes are
pandas pickles, which can run code, and are not read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import get_intrinsics, get_pose
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.errors import InputError, quote_value
from gscompleter.io.json_file import read_json

FRONT = "front_camera"
INTRINSICS, POSES = "intrinsics.json", "poses.json"
ADVICE = "copy the sequence again"
NO_DEPTH = (
    "The point clouds and boxes of PandaSet are not read, because they are pandas pickles, which "
    "can run any code."
)


def has_pandaset(path: Path) -> bool:
    """Check whether `path` is the folder of a sequence."""
    return os.path.isfile(path / "camera" / FRONT / POSES)


def open_pandaset(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a sequence; its folder names it.

    Frames are numbered camera by camera, the front camera first, and by time.
    """
    folders = sorted((path / "camera").iterdir(), key=lambda f: (f.name != FRONT, f.name))
    cameras = [folder for folder in folders if os.path.isfile(folder / POSES)]
    frames = [frame for folder in cameras for frame in _read_frames(folder)]
    if not frames:
        raise InputError(f"There are no poses in {quote_value(path)}; {ADVICE}.")
    found = build_drive(path.resolve().name, str(path), frames, front=FRONT)
    yield replace(found, notes=(NO_DEPTH,))


def _read_frames(folder: Path) -> Iterator[Frame]:
    poses, lens = (read_json(folder / name, ADVICE) for name in (POSES, INTRINSICS))
    if not isinstance(poses, list):
        raise InputError(f"{quote_value(folder / POSES)} is no list of poses; {ADVICE}.")
    entry = lens if isinstance(lens, dict) else {}
    intrinsics = get_intrinsics(entry, quote_value(folder / INTRINSICS))
    for number, pose in enumerate(poses):
        title = f"pose {number} of {quote_value(folder / POSES)}"
        c2w = get_pose(pose, "position", "heading", "wxyz", title)
        image = folder / f"{number:02d}"
        name = f"{folder.name}/{image.name}"
        yield Frame(name, title, c2w, intrinsics, image, sensor=folder.name)
