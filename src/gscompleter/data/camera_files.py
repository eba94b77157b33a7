"""Readers for files that hold cameras without photographs."""

from __future__ import annotations

import os
from pathlib import Path

from gscompleter.data.camera_list import read_camera_list
from gscompleter.data.colmap.scene import (
    has_colmap,
    is_image_file,
    read_image_file,
    read_scene_cameras,
)
from gscompleter.data.frame import Frame
from gscompleter.data.other_exports import refuse_other_exports
from gscompleter.data.resize import Resolution
from gscompleter.data.supersplat import is_supersplat, parse_poses
from gscompleter.data.transforms import NAME, read_frames
from gscompleter.io.json_file import read_json


def read_cameras(path: Path, resolution: Resolution = None) -> list[Frame]:
    """Read the cameras of a file in its order; `load_cameras` lists the formats."""
    if is_image_file(path):
        return read_image_file(path)
    if os.path.isdir(path):
        is_colmap = not os.path.isfile(path / NAME) and has_colmap(path)
        return read_scene_cameras(path) if is_colmap else read_frames(path / NAME)
    refuse_other_exports(path)
    content = read_json(path, "name a file of cameras")
    if is_supersplat(content):
        return parse_poses(content, path, resolution)
    return read_camera_list(path) if isinstance(content, list) else read_frames(path)
