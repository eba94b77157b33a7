"""Files of cameras without photographs, from several programs.

* Inria's `cameras.json` is a list of objects with id, img_name, width, height, position, rotation,
  fx and fy. Position and rotation are camera-to-world in OpenCV axes; the principal point is the
  image centre.
* SuperSplat's poses are the `poseSets` of a project's document.json, or the list. A pose has a
  position and a target in the world of the splat rotated by 180° about z, where y points up. It has
  no image size and no roll: cameras are upright, with the field of view of the longer side.
* Camera paths of nerfstudio's viewer are read by `camera_paths.py`.
* Exports of Metashape and RealityScan, unstitched files of Insta360, and models without cameras are
  refused, with advice.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.camera_paths import FOV_RANGE, find_world, is_camera_path, parse_camera_path
from gscompleter.data.cameras import Intrinsics
from gscompleter.data.colmap import has_colmap, is_image_file, read_image_file, read_scene_cameras
from gscompleter.data.frame import Frame, keep_existing, locate_images
from gscompleter.data.json_fields import (
    get_array,
    get_focal,
    get_optional_number,
    get_part,
    get_size,
    get_text,
)
from gscompleter.data.limits import require
from gscompleter.data.photographs import (
    Photographs,
    Resolution,
    build_photographs,
    check_resolution,
)
from gscompleter.data.transforms import TRANSFORMS_FILE, read_frames
from gscompleter.system.damage import describe_damage
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import (
    MAX_JSON,
    ZIP_ERRORS,
    is_json_list,
    list_entries,
    parse_json,
    read_head,
    read_json,
    read_zip_entry,
)
from gscompleter.system.files.writing import replace_file
from gscompleter.types import Camera

INRIA_CAMERAS_FILE = "cameras.json"
CAMERAS_ADVICE = "export the cameras again"
PROJECT_ENDING = ".ssproj"
PROJECT_CAMERAS = "document.json"
DEFAULT_FOV = 60.0
"""SuperSplat's default field of view, in degrees."""
SPLAT_FROM_WORLD = np.array([-1.0, -1.0, 1.0])
"""Axis factors from SuperSplat's world to the splat: 180° about z."""

METASHAPE = ("cameras of Metashape", "export its cameras as COLMAP, which Metashape does since 2.2")
REALITYSCAN = ("cameras of RealityScan", "export its registration as COLMAP")
INSTA360 = ("unstitched images of Insta360", "export 360° JPEG or MP4 (2:1) from Insta360 Studio")
EXPORTS = (
    ((".psx", ".psz"), b"", METASHAPE),
    ((".xml",), b"<chunk", METASHAPE),
    ((".rspj", ".rcproj"), b"", REALITYSCAN),
    ((".csv",), b"#name,", REALITYSCAN),
    ((".csv",), b"#cameras", REALITYSCAN),
    ((".insp", ".insv"), b"", INSTA360),
)
"""Endings of files that are not read, what their first bytes hold, their content and what to do."""
MODEL_FILE_ENDINGS = (".usdz", ".fbx", ".las", ".laz", ".obj", ".stl")


def read_cameras(path: Path, resolution: Resolution = None) -> list[Frame]:
    """Read the cameras of a file in its order; `load_cameras` lists the formats."""
    if is_image_file(path):
        return read_image_file(path)
    if os.path.isdir(path):
        is_colmap = not os.path.isfile(path / TRANSFORMS_FILE) and has_colmap(path)
        return read_scene_cameras(path) if is_colmap else read_frames(path / TRANSFORMS_FILE)
    refuse_other_exports(path)
    content = read_document(path)

    if _is_supersplat(path, content):
        return _parse_supersplat(content, path, resolution)
    if is_camera_path(content):
        return parse_camera_path(content, path)
    return read_camera_list(path) if isinstance(content, list) else read_frames(path)


def read_document(path: Path) -> Any:
    """Read a file of cameras in JSON, or that of a project of SuperSplat."""
    if path.suffix.lower() != PROJECT_ENDING:
        return read_json(path, "name a file of cameras")
    # Splats lie beside it in the project, so that it is not read as a whole.
    try:
        with zipfile.ZipFile(path) as project:
            data = read_zip_entry(project, PROJECT_CAMERAS, MAX_JSON)
    except ZIP_ERRORS as error:
        raise InputError(
            f"{quote_value(path)} is no project of SuperSplat "
            f"({quote_value(describe_damage(error))}); save it again."
        ) from error
    return parse_json(data, path, CAMERAS_ADVICE)


def is_in_splat_frame(path: Path) -> bool:
    """Check whether the cameras of a file are in the frame of a splat, not of photographs.

    So are poses of SuperSplat, and paths of nerfstudio without the transform of their run.
    """
    if path.suffix.lower() not in (".json", PROJECT_ENDING) or not os.path.isfile(path):
        return False
    content = read_document(path)
    return _is_supersplat(path, content) or (is_camera_path(content) and find_world(path) is None)


def has_camera_list(path: Path) -> bool:
    """Check whether `path` is a JSON list of cameras, or a folder with a `cameras.json`."""
    file = path / INRIA_CAMERAS_FILE if os.path.isdir(path) else path
    return file.suffix == ".json" and os.path.isfile(file) and is_json_list(file)


def open_camera_list(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a `cameras.json`; the folder names the scene.

    Photographs lie beside the file, in `images` or another usual folder. Frames are numbered by the
    sorted names of the photographs that exist.
    """
    file = path / INRIA_CAMERAS_FILE if os.path.isdir(path) else path
    frames = locate_images(read_camera_list(file), [file.parent])
    there, notes = keep_existing(frames, quote_value(file))
    name = file.parent.resolve().name if file.name == INRIA_CAMERAS_FILE else file.stem
    yield replace(build_photographs(name, quote_value(file), there), notes=notes)


def read_camera_list(path: Path) -> list[Frame]:
    """Read the cameras of a `cameras.json` in its order, without photographs."""
    content = read_json(path, CAMERAS_ADVICE)
    require(
        isinstance(content, list) and content,
        f"{quote_value(path)} lists no cameras; a list of cameras is needed, {CAMERAS_ADVICE}.",
    )
    return [_parse_inria_camera(entry, number, path) for number, entry in enumerate(content)]


def write_camera_list(path: Path, cameras: Mapping[str, Camera]) -> None:
    """Write cameras by the names of their photographs, as trainers do beside a splat.

    The format has no principal point: it is the image centre.
    """
    entries = []
    for number, (name, camera) in enumerate(cameras.items()):
        (fx, _, _), (_, fy, _), _ = camera.K.double().tolist()
        c2w = camera.c2w.detach().cpu().double()
        entries.append(
            {
                "id": number,
                "img_name": name,
                "width": camera.width,
                "height": camera.height,
                "position": c2w[:3, 3].tolist(),
                "rotation": c2w[:3, :3].tolist(),
                "fx": fx,
                "fy": fy,
            }
        )
    with replace_file(path) as file:
        file.write((json.dumps(entries) + "\n").encode())


def _parse_inria_camera(entry: Any, number: int, path: Path) -> Frame:
    title = f"camera {number} of {quote_value(path)}"
    focal = get_focal(entry, title)
    size = get_size(entry, title)
    name = get_text(entry, "img_name", title) or str(entry.get("id", number))
    c2w = np.eye(4)
    c2w[:3, :3] = get_array(entry, "rotation", title, (3, 3))
    c2w[:3, 3] = get_array(entry, "position", title, (3,))
    return Frame(name, title, c2w, Intrinsics(size, focal), None).with_rigid_pose()


def _is_supersplat(path: Path, content: Any) -> bool:
    if path.suffix.lower() == PROJECT_ENDING:
        return True
    # A JSON file does not name its program; the keys tell it.
    first = content[0] if isinstance(content, list) and content else content
    keys = first if isinstance(first, dict) else {}
    # An entry of Inria's cameras.json has a rotation where SuperSplat has a target.
    return "poseSets" in keys or ("target" in keys and "rotation" not in keys)


def _parse_supersplat(content: Any, path: Path, resolution: Resolution) -> list[Frame]:
    """Read SuperSplat's poses as cameras in the frame of the splat.

    `resolution` has to be height and width; raises InputError otherwise, or if there are no poses.
    """
    check_resolution(resolution)
    if not isinstance(resolution, (tuple, list)):
        raise InputError(
            f"The poses of SuperSplat in {quote_value(path)} have no image size; give a resolution "
            "(height and width).",
            "resolution",
        )
    if isinstance(content, dict):
        # A project may hold several sets of poses; the first is read.
        sets = get_part(content, "poseSets", list)
        content = get_part(sets[0] if sets else None, "poses", list)
    require(
        isinstance(content, list) and content,
        f"{quote_value(path)} holds no poses; {CAMERAS_ADVICE}.",
    )
    return [
        _parse_supersplat_pose(pose, f"pose {number} of {quote_value(path)}", resolution)
        for number, pose in enumerate(content)
    ]


def _parse_supersplat_pose(pose: Any, title: str, resolution: tuple[int, int]) -> Frame:
    position = get_array(pose, "position", title, (3,)) * SPLAT_FROM_WORLD
    target = get_array(pose, "target", title, (3,)) * SPLAT_FROM_WORLD
    height, width = resolution
    fov = get_optional_number(pose, "fov", title, *FOV_RANGE) or DEFAULT_FOV
    # Square pixels: the field of view is that of the longer side.
    focal = max(height, width) / 2 / math.tan(math.radians(fov) / 2)
    intrinsics = Intrinsics((width, height), (focal, focal))
    return Frame(title, title, _build_upright_c2w(position, target), intrinsics, None)


def _build_upright_c2w(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Build camera-to-world of an upright camera that points at a target.

    NaN if it looks along y, where nothing tells what is upright, or stands at the target.
    """
    # In the splat y points down, as in the camera: x is level, and y completes the axes.
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
    require(
        path.suffix.lower() not in MODEL_FILE_ENDINGS,
        f"{quote_value(path)} is a model without photographs and cameras, which is all that "
        "Scaniverse exports; record with Polycam, Record3D or 3d Scanner App, or take photographs.",
    )
    inside = list_entries(path)
    for file, (endings, mark, (content, advice)) in product([path, *inside], EXPORTS):
        require(
            file.suffix.lower() not in endings or mark not in read_head(file, 4096),
            f"{quote_value(file)} holds {content}, which cannot be read; {advice}, or "
            "name a folder of the photographs alone.",
        )
