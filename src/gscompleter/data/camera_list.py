"""Lists of cameras in the layout of Inria's 3DGS code (`cameras.json`).

Each entry has id, img_name, width, height, position, rotation, fx and fy. Position and rotation are
camera-to-world in OpenCV axes; the principal point is the image centre.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, find_pose_defect, make_rigid
from gscompleter.data.frame import Frame, capitalize
from gscompleter.data.image_folders import ImageFinder, keep_existing
from gscompleter.data.json_fields import get_array, get_number, get_size, get_text
from gscompleter.data.limits import MAX_IN_PIXELS
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.errors import InputError, quote_value
from gscompleter.io.json_file import is_json_list, read_json

NAME = "cameras.json"
ADVICE = "export the cameras again"


def has_camera_list(path: Path) -> bool:
    """Check whether `path` is a JSON list of cameras, or a folder with a `cameras.json`."""
    file = path / NAME if os.path.isdir(path) else path
    return file.suffix == ".json" and os.path.isfile(file) and is_json_list(file)


def open_camera_list(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a `cameras.json`; the folder names the scene.

    Photographs lie beside the file, in `images` or another usual folder. Frames are numbered by the
    sorted names of the photographs that exist.
    """
    file = path / NAME if os.path.isdir(path) else path
    finder = ImageFinder([file.parent])
    frames = [finder.locate(frame) for frame in read_camera_list(file)]
    there, notes = keep_existing(frames, str(file))
    name = file.resolve().parent.name if file.name == NAME else file.stem
    yield replace(build_photographs(name, str(file), there), notes=notes)


def read_camera_list(path: Path) -> list[Frame]:
    """Read the cameras of a JSON list in its order, without photographs."""
    content = read_json(path, ADVICE)
    if not isinstance(content, list) or not content:
        raise InputError(
            f"{quote_value(path)} lists no cameras; a list of cameras is needed, {ADVICE}."
        )
    return [_parse_frame(entry, number, path) for number, entry in enumerate(content)]


def _parse_frame(entry: Any, number: int, path: Path) -> Frame:
    title = f"camera {number} of {quote_value(path)}"
    if not isinstance(entry, dict):
        raise InputError(
            f"{capitalize(title)} is no object with a position and a rotation; {ADVICE}."
        )
    fx, fy = (
        get_number(entry, key, title, 1 / MAX_IN_PIXELS, MAX_IN_PIXELS) for key in ("fx", "fy")
    )
    name = get_text(entry, "img_name", title) or str(entry.get("id", number))
    intrinsics = Intrinsics(get_size(entry, title), (fx, fy))
    frame = Frame(name, title, _parse_pose(entry, title), intrinsics, None)
    defect = find_pose_defect(frame.c2w)
    if defect is not None:
        raise frame.make_error(defect)
    return replace(frame, c2w=make_rigid(frame.c2w))


def _parse_pose(entry: dict[str, Any], title: str) -> Float[np.ndarray, "4 4"]:
    c2w = np.eye(4)
    c2w[:3, :3] = get_array(entry, "rotation", (3, 3), title)
    c2w[:3, 3] = get_array(entry, "position", (3,), title)
    return c2w
