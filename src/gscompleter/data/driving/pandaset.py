"""PandaSet sequences: a folder per camera with images, intrinsics and poses.

Poses are camera-to-world in OpenCV axes, as position and quaternion. Point clouds and boxes are
pandas pickles, which can run code, and are not read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, compute_rotation
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import get_number
from gscompleter.data.limits import MAX_COORDINATE, MAX_IN_PIXELS
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


def _read_frames(folder: Path) -> list[Frame]:
    poses = read_json(folder / POSES, ADVICE)
    if not isinstance(poses, list):
        raise InputError(f"{quote_value(folder / POSES)} is no list of poses; {ADVICE}.")
    intrinsics = _read_intrinsics(folder / INTRINSICS)
    return [_make_frame(folder, number, pose, intrinsics) for number, pose in enumerate(poses)]


def _make_frame(folder: Path, number: int, pose: Any, intrinsics: Intrinsics) -> Frame:
    title = f"pose {number} of {quote_value(folder / POSES)}"
    image = folder / f"{number:02d}"
    name = f"{folder.name}/{image.name}"
    return Frame(name, title, _parse_pose(pose, title), intrinsics, image, sensor=folder.name)


def _parse_pose(pose: Any, title: str) -> Float[np.ndarray, "4 4"]:
    def read_numbers(part: str, keys: str) -> list[float]:
        entry = pose.get(part) if isinstance(pose, dict) else None
        entry = entry if isinstance(entry, dict) else {}
        return [get_number(entry, key, title, -MAX_COORDINATE, MAX_COORDINATE) for key in keys]

    c2w = np.eye(4)
    c2w[:3, :3] = compute_rotation(read_numbers("heading", "wxyz"))
    c2w[:3, 3] = read_numbers("position", "xyz")
    return c2w


def _read_intrinsics(path: Path) -> Intrinsics:
    content = read_json(path, ADVICE)
    entry, title = content if isinstance(content, dict) else {}, quote_value(path)
    fx, fy = (
        get_number(entry, key, title, 1 / MAX_IN_PIXELS, MAX_IN_PIXELS) for key in ("fx", "fy")
    )
    cx, cy = (get_number(entry, key, title, -MAX_IN_PIXELS, MAX_IN_PIXELS) for key in ("cx", "cy"))
    return Intrinsics(None, (fx, fy), (cx, cy))
