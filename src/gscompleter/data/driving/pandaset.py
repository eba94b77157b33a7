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

FRONT_CAMERA_FOLDER = "front_camera"
PANDASET_POSES_FILE = "poses.json"
PANDASET_ADVICE = "copy the sequence again"


def has_pandaset(path: Path) -> bool:
    """Check whether `path` is the folder of a sequence."""
    return os.path.isfile(path / "camera" / FRONT_CAMERA_FOLDER / PANDASET_POSES_FILE)


def open_pandaset(path: Path) -> Iterator[Photographs]:
    """Open a sequence; frames are numbered by camera, the front camera first, and time."""
    files = (path / "camera").glob(f"*/{PANDASET_POSES_FILE}")
    cameras = sorted(files, key=lambda file: (file.parent.name != FRONT_CAMERA_FOLDER, file))
    frames = [frame for file in cameras for frame in _read_frames(file)]
    require(frames, f"There are no poses in {quote_value(path)}; {PANDASET_ADVICE}.")
    yield build_drive(path.resolve().name, quote_value(path), frames, front=FRONT_CAMERA_FOLDER)


def _read_frames(file: Path) -> Iterator[Frame]:
    camera = file.parent
    poses = read_json(file, PANDASET_ADVICE)
    lens = file.with_name("intrinsics.json")
    require(isinstance(poses, list), f"{quote_value(file)} is no list of poses; {PANDASET_ADVICE}.")
    intrinsics = get_intrinsics(read_json(lens, PANDASET_ADVICE), quote_value(lens))
    for number, pose in enumerate(poses):
        title = f"pose {number} of {quote_value(file)}"
        c2w = get_pose(pose, "position", "heading", "wxyz", title)
        image = camera / f"{number:02d}"
        name = f"{camera.name}/{image.name}"
        yield Frame(name, title, c2w, intrinsics, image, sensor=camera.name)
