"""PandaSet sequences: a folder per camera with images, intrinsics and poses.

Poses are camera-to-world in OpenCV axes, as position and quaternion. Point clouds and boxes are
pandas pickles, which can run code, and are not read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import get_intrinsics, get_pose
from gscompleter.data.limits import require
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.system.errors import quote_value
from gscompleter.system.files.reading import read_json

FRONT = "front_camera"
POSES = "poses.json"
ADVICE = "copy the sequence again"


def has_pandaset(path: Path) -> bool:
    """Check whether `path` is the folder of a sequence."""
    return os.path.isfile(path / "camera" / FRONT / POSES)


def open_pandaset(path: Path) -> Iterator[Photographs]:
    """Open a sequence; frames are numbered by camera, the front camera first, and time."""
    files = (path / "camera").glob(f"*/{POSES}")
    cameras = sorted(files, key=lambda file: (file.parent.name != FRONT, file))
    frames = [frame for file in cameras for frame in _read_frames(file)]
    require(frames, f"There are no poses in {quote_value(path)}; {ADVICE}.")
    yield build_drive(path.resolve().name, str(path), frames, front=FRONT)


def _read_frames(file: Path) -> Iterator[Frame]:
    camera = file.parent
    poses = read_json(file, ADVICE)
    lens = file.with_name("intrinsics.json")
    require(isinstance(poses, list), f"{quote_value(file)} is no list of poses; {ADVICE}.")
    intrinsics = get_intrinsics(read_json(lens, ADVICE), quote_value(lens))
    for number, pose in enumerate(poses):
        title = f"pose {number} of {quote_value(file)}"
        c2w = get_pose(pose, "position", "heading", "wxyz", title)
        image = camera / f"{number:02d}"
        name = f"{camera.name}/{image.name}"
        yield Frame(name, title, c2w, intrinsics, image, sensor=camera.name)
