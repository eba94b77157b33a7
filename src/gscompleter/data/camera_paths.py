"""Camera paths of nerfstudio's viewer (`camera_path.json`).

A path has the size of its images, and cameras with `camera_to_world` (row by row, OpenGL axes) and
the vertical field of view in degrees. They are in the frame that nerfstudio trained in: its
`dataparser_transforms.json`, where that lies beside the path or one folder above, leads from the
world of the reconstruction to it. A transforms.json there may have rotated and scaled that world
before (`applied_transform`, `applied_scale`).
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.file_names import list_homes_of
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import (
    get_array,
    get_number,
    get_optional_number,
    get_part,
    get_size,
)
from gscompleter.data.limits import require
from gscompleter.data.transforms import (
    DATAPARSER_FILE,
    OPENCV_FROM_OPENGL,
    SCALE_RANGE,
    TRANSFORMS_FILE,
    read_dataparser_transforms,
)
from gscompleter.system.errors import quote_value
from gscompleter.system.files.reading import read_json

CAMERA_PATH_ADVICE = "export the camera path again"
APPLIED = ("applied_transform", "applied_scale")
"""Keys of a transforms.json for what was done to the reconstruction before it was written."""
FOV_RANGE = (1.0, 179.0)
"""Range of a field of view, in degrees."""


def is_camera_path(content: Any) -> bool:
    """Check whether the content of a JSON file is a camera path."""
    return isinstance(content, dict) and isinstance(content.get("camera_path"), list)


def parse_camera_path(content: Any, path: Path) -> list[Frame]:
    """Parse the cameras of a path, in the world of the scene's photographs if it is known."""
    kind = content.get("camera_type", "perspective")
    require(
        kind == "perspective",
        f"The cameras of {quote_value(path)} are of the type {quote_value(kind)}; export a "
        "perspective path.",
    )
    entries = get_part(content, "camera_path", list)
    require(entries, f"{quote_value(path)} holds no camera; {CAMERA_PATH_ADVICE}.")
    size = get_size(content, quote_value(path), "render_width", "render_height")
    to_photographs = find_world(path)
    return [
        _parse_path_camera(entry, f"camera {number} of {quote_value(path)}", size, to_photographs)
        for number, entry in enumerate(entries)
    ]


def find_world(path: Path) -> Float[np.ndarray, "4 4"] | None:
    """Find the similarity from the frame of a path to that of the photographs; None if unknown."""
    folders = [folder for home in list_homes_of(path) for folder in (home, home.parent)]
    files = [folder / DATAPARSER_FILE for folder in folders]
    dataparser = next((file for file in files if os.path.isfile(file)), None)
    if dataparser is None:
        return None
    # The trained frame is `dataparser` applied to the reconstruction, so its inverse leads back.
    to_original = np.linalg.inv(read_dataparser_transforms(dataparser))
    exports = [folder / TRANSFORMS_FILE for folder in folders]
    for file in filter(os.path.isfile, exports):
        content = read_json(file, CAMERA_PATH_ADVICE)
        if isinstance(content, dict) and any(content.get(key) is not None for key in APPLIED):
            return _follow_export(content, quote_value(file), to_original)
    return to_original


def _follow_export(
    content: Any, title: str, to_original: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Follow what was done to the reconstruction before transforms.json was written.

    Photographs read from that file are in its world. `to_original` leads from the frame of a path
    to the reconstruction, and the result to that world.
    """
    # `ns-process-data` rotates COLMAP's world.
    applied = np.eye(4)
    if content.get("applied_transform") is not None:
        applied[:3] = get_array(content, "applied_transform", title, (3, 4), (4, 4))[:3]
    # nerfstudio's `scale` of a run has this one as a factor, although positions were scaled already
    # before its `transform`: undoing that of the run alone leads to the file's own unit.
    scale = get_optional_number(content, "applied_scale", title, *SCALE_RANGE) or 1.0
    return applied @ to_original @ np.diag([scale, scale, scale, 1.0])


def _parse_path_camera(
    entry: Any,
    title: str,
    size: tuple[int, int],
    to_photographs: Float[np.ndarray, "4 4"] | None,
) -> Frame:
    """Parse a camera, whose frame `to_photographs` leads to that of the photographs."""
    # Either 16 numbers row by row, or nested rows with or without the last one.
    numbers = get_array(entry, "camera_to_world", title, (16,), (4, 4), (3, 4))
    c2w = np.eye(4)
    c2w[:3] = numbers.reshape(-1, 4)[:3]
    fov = get_number(entry, "fov", title, *FOV_RANGE)
    # The angle is that of the height; pixels are square.
    focal = size[1] / 2 / math.tan(math.radians(fov) / 2)
    camera = Frame(title, title, c2w, Intrinsics(size, (focal, focal)), None).with_rigid_pose()
    pose = camera.c2w @ OPENCV_FROM_OPENGL
    if to_photographs is not None:
        pose = to_photographs @ pose
        # The similarity scaled the axes of the camera, too, which have the length one.
        pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
    return replace(camera, c2w=pose)
