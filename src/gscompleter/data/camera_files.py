"""Files of cameras without photographs, from several programs.

* Inria's `cameras.json` is a list of objects with id, img_name, width, height, position, rotation,
  fx and fy. Position and rotation are camera-to-world in OpenCV axes; the principal point is the
  image centre.
* SuperSplat's poses are the `poseSets` of a project's document.json, or the list. A pose has a
  position and a target in SuperSplat's world, which is that of the splat rotated by 180° about z,
  so that y points up. It has neither image size nor roll: cameras are upright, and their field of
  view is that of the longer side.
* Exports of Metashape, RealityScan and Polycam are refused, with advice.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.colmap.scene import (
    has_colmap,
    is_image_file,
    read_image_file,
    read_scene_cameras,
)
from gscompleter.data.frame import Frame, capitalize
from gscompleter.data.image_folders import ImageFinder, keep_existing
from gscompleter.data.json_fields import (
    get_array,
    get_focal,
    get_list,
    get_optional_number,
    get_size,
    get_text,
)
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.resize import Resolution
from gscompleter.data.transforms import NAME as TRANSFORMS
from gscompleter.data.transforms import read_frames
from gscompleter.errors import InputError, quote_value
from gscompleter.io.json_file import is_json_list, read_json
from gscompleter.io.reading import read_head

NAME = "cameras.json"
ADVICE = "export the cameras again"
DEFAULT_FOV = 60.0
"""SuperSplat's default field of view, in degrees."""
FOV_RANGE = (1.0, 179.0)
"""Range of SuperSplat's field of view, in degrees."""
SPLAT_FROM_WORLD = np.array([-1.0, -1.0, 1.0])
"""Axis factors from SuperSplat's world to the splat: 180° about z."""

HEAD = 4096
EXPORT_ADVICE = {
    "Metashape": "export its cameras as COLMAP, which Metashape does since 2.2",
    "RealityScan": "export its registration as COLMAP",
    "Polycam": "turn it into nerfstudio's transforms.json by ns-process-data polycam",
}
PROJECTS = {
    ".psx": "Metashape",
    ".psz": "Metashape",
    ".rspj": "RealityScan",
    ".rcproj": "RealityScan",
}
POLYCAM_CAMERAS = ("cameras", "corrected_cameras")


def read_cameras(path: Path, resolution: Resolution = None) -> list[Frame]:
    """Read the cameras of a file in its order; `load_cameras` lists the formats."""
    if is_image_file(path):
        return read_image_file(path)
    if os.path.isdir(path):
        is_colmap = not os.path.isfile(path / TRANSFORMS) and has_colmap(path)
        return read_scene_cameras(path) if is_colmap else read_frames(path / TRANSFORMS)
    refuse_other_exports(path)
    content = read_json(path, "name a file of cameras")
    if _is_supersplat(content):
        return _parse_supersplat(content, path, resolution)
    return read_camera_list(path) if isinstance(content, list) else read_frames(path)


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
    """Read the cameras of a `cameras.json` in its order, without photographs."""
    content = read_json(path, ADVICE)
    if not isinstance(content, list) or not content:
        raise InputError(
            f"{quote_value(path)} lists no cameras; a list of cameras is needed, {ADVICE}."
        )
    return [_parse_camera(entry, number, path) for number, entry in enumerate(content)]


def _parse_camera(entry: Any, number: int, path: Path) -> Frame:
    title = f"camera {number} of {quote_value(path)}"
    if not isinstance(entry, dict):
        raise InputError(
            f"{capitalize(title)} is no object with a position and a rotation; {ADVICE}."
        )
    focal = get_focal(entry, title)
    name = get_text(entry, "img_name", title) or str(entry.get("id", number))
    intrinsics = Intrinsics(get_size(entry, title), focal)
    c2w = np.eye(4)
    c2w[:3, :3] = get_array(entry, "rotation", (3, 3), title)
    c2w[:3, 3] = get_array(entry, "position", (3,), title)
    return Frame(name, title, c2w, intrinsics, None).with_rigid_pose()


def _is_supersplat(content: Any) -> bool:
    if isinstance(content, dict):
        return "poseSets" in content
    first = content[0] if isinstance(content, list) and content else None
    return isinstance(first, dict) and "target" in first and "rotation" not in first


def _parse_supersplat(content: Any, path: Path, resolution: Resolution) -> list[Frame]:
    """Read SuperSplat's poses as cameras in the frame of the splat; `resolution` must be given."""
    if resolution is None or isinstance(resolution, int):
        raise InputError(
            f"The poses of SuperSplat in {quote_value(path)} have no image size; give a resolution "
            "(height and width).",
            "resolution",
        )
    sets = get_list(content, "poseSets")
    poses = content if isinstance(content, list) else get_list(sets[0] if sets else None, "poses")
    if not poses:
        raise InputError(f"{quote_value(path)} holds no poses; {ADVICE}.")
    titles = (f"pose {number} of {quote_value(path)}" for number in range(len(poses)))
    pairs = zip(poses, titles, strict=True)
    return [_parse_supersplat_pose(pose, title, resolution) for pose, title in pairs]


def _parse_supersplat_pose(pose: Any, title: str, resolution: tuple[int, int]) -> Frame:
    if not isinstance(pose, dict):
        raise InputError(
            f"{capitalize(title)} is no object with a position and a target; {ADVICE}."
        )
    position, target = (
        get_array(pose, key, (3,), title) * SPLAT_FROM_WORLD for key in ("position", "target")
    )
    height, width = resolution
    fov = get_optional_number(pose, "fov", title, *FOV_RANGE) or DEFAULT_FOV
    focal = max(height, width) / 2 / math.tan(math.radians(fov) / 2)
    intrinsics = Intrinsics((width, height), (focal, focal))
    return Frame(title, title, _build_upright_c2w(position, target), intrinsics, None)


def _build_upright_c2w(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Build camera-to-world of an upright camera that points at a target; NaN along y."""
    with np.errstate(all="ignore"):
        z = (target - position) / np.linalg.norm(target - position)
        x = np.cross([0.0, 1.0, 0.0], z)
        x = x / np.linalg.norm(x)
    c2w = np.eye(4)
    c2w[:3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    c2w[:3, 3] = position
    return c2w


def refuse_other_exports(path: Path) -> None:
    """Raise an InputError with advice if `path` holds cameras of an unsupported program."""
    files = sorted(path.iterdir()) if os.path.isdir(path) else [path]
    found = "Polycam" if _is_polycam(path) else None
    for file in files:
        if found is None and os.path.isfile(file):
            found, path = _detect_program(file), file
    if found is not None:
        raise InputError(
            f"{quote_value(path)} holds cameras of {found}, which cannot be read; "
            f"{EXPORT_ADVICE[found]}, or name a folder of the photographs alone."
        )


def _detect_program(file: Path) -> str | None:
    ending = file.suffix.lower()
    head = _read_text_head(file) if ending in (".xml", ".csv") else b""
    if ending == ".xml" and b"<document" in head and b"<chunk" in head:
        return "Metashape"
    if ending == ".csv" and head.startswith((b"#name,", b"#cameras")):
        return "RealityScan"
    return PROJECTS.get(ending)


def _is_polycam(path: Path) -> bool:
    """Check for Polycam's raw data, or the keyframes in it."""
    homes = (path / home / kind for home in ("", "keyframes") for kind in POLYCAM_CAMERAS)
    cameras = (file for home in homes for file in sorted(home.glob("*.json"))[:1])
    return any(b'"t_00"' in _read_text_head(file) for file in cameras)


def _read_text_head(file: Path) -> bytes:
    return read_head(file, HEAD).removeprefix(b"\xef\xbb\xbf")
