"""Validated reading and writing of nerfstudio's `transforms.json`, without opening images.

A trained model has its scene in another frame: `dataparser_transforms.json` leads to it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import (
    PANORAMA_ADVICE,
    PANORAMA_MODEL,
    Distortion,
    Intrinsics,
    find_pose_defect,
)
from gscompleter.data.file_names import FolderListings, list_endings, locate
from gscompleter.data.frame import Frame, find_file, find_image
from gscompleter.data.json_fields import (
    get_array,
    get_number,
    get_optional_number,
    get_part,
    get_size,
    get_text,
)
from gscompleter.data.limits import DEPTH_RANGE, MAX_COEFFICIENT, MAX_NUMBER, require
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.points import read_point_cloud
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.depth_file import read_depth
from gscompleter.system.files.reading import is_json_list, read_json
from gscompleter.system.files.result_format import is_marked, refuse_later
from gscompleter.system.files.writing import replace_file

TRANSFORMS_FILE = "transforms.json"
TRANSFORMS_ADVICE = "export the scene again"
DATAPARSER_FILE = "dataparser_transforms.json"
"""File of a nerfstudio run with the transform that it applied to the scene."""
SPLITS = tuple(f"transforms_{split}.json" for split in ("train", "val", "test"))
"""Files of a scene in parts, as in NeRF's synthetic scenes."""
TRANSFORMS_HOMES = ("", "nerfstudio")
"""Subfolders that may hold the file; DL3DV has the second."""

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Axis flip: nerfstudio's cameras look along -z with y up, ours along z with y down."""

PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

ANGLE_RANGE = (1e-5, 3.14159)
"""Range of fields of view in radians, below π."""
SCALE_RANGE = (1e-9, 1e9)
"""Accepted range of the `scale` in a file of a nerfstudio run."""
DEPTH_UNITS = ("depth_unit_scale_factor", "integer_depth_scale")

NumberPair = tuple[float | None, float | None]


def has_transforms(path: Path) -> bool:
    """Check for a JSON object, or a folder with a `transforms.json`, whole or in parts."""
    if os.path.isdir(path):
        return bool(_find_files(path))
    return path.suffix == ".json" and os.path.isfile(path) and not is_json_list(path)


def open_transforms(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a `transforms.json`; its folder names the scene.

    Frames are numbered by sorted `file_path`, those of train, val and test together; if one lacks a
    path, by their order in the file. Poses and points stay in the frame of the file:
    `applied_transform`, the exporter's change of COLMAP's frame, is not undone.
    """
    files = _find_files(path)
    frames = [frame for file in files for frame in read_frames(file)]
    if all(frame.image is not None for frame in frames):
        frames = sorted(frames, key=lambda frame: frame.name)
    folder = files[0].parent.resolve()
    name = (folder.parent if folder.name in TRANSFORMS_HOMES else folder).name
    if len(files) == 1 and files[0].name not in (TRANSFORMS_FILE, *SPLITS):
        name = files[0].stem
    scene = build_photographs(name, quote_value(files[0] if len(files) == 1 else path), frames)
    yield replace(scene, sparse=_make_cloud_reader(files))


def _find_files(scene: Path) -> list[Path]:
    if not os.path.isdir(scene):
        return [scene]
    groups = [
        [scene / home / n for n in names]
        for home in TRANSFORMS_HOMES
        for names in ((TRANSFORMS_FILE,), SPLITS)
    ]
    for group in groups:
        files = [file for file in group if os.path.isfile(file)]
        if files:
            return files
    return []


def _make_cloud_reader(files: Sequence[Path]) -> partial[Float[np.ndarray, "n 3"]] | None:
    """Return a reader of the points that a file names; None if there are none."""
    for file in files:
        name = get_text(read_json(file, TRANSFORMS_ADVICE), "ply_file_path", quote_value(file))
        path = None if name is None else locate(file.parent, name, _find_any_case)
        if path is not None and os.path.isfile(path):
            return partial(read_point_cloud, path)
    return None


def _find_any_case(path: Path, listings: FolderListings | None = None) -> Path | None:
    """Find a file whose name may be written in another case; None if there is none."""
    return find_file([path.parent], [path.name], listings)


def read_frames(path: Path) -> list[Frame]:
    """Read the frames of a JSON file in its order, with exactly rigid poses (`make_rigid`)."""
    content = read_json(path, TRANSFORMS_ADVICE)
    if is_marked(content):  # `targets.json`, for example
        refuse_later(content, quote_value(path))
    entries = get_part(content, "frames", list)
    require(
        entries, f"{quote_value(path)} lists no frames; its `frames` has to be a list with cameras."
    )
    # Integers in depth maps are millimetres by default, as nerfstudio takes them.
    units = (
        get_optional_number(content, key, quote_value(path), *DEPTH_RANGE) for key in DEPTH_UNITS
    )
    unit = next((unit for unit in units if unit is not None), 1e-3)
    listings = FolderListings()
    return [
        _parse_transforms_frame(entry, i, content, unit, path, listings)
        for i, entry in enumerate(entries)
    ]


def _parse_transforms_frame(
    entry: Any,
    position: int,
    content: Mapping[str, Any],
    depth_unit: float,
    path: Path,
    listings: FolderListings,
) -> Frame:
    title = f"frame {position} of {quote_value(path)}"
    file_path = get_text(entry, "file_path", title)
    title = title if file_path is None else f"frame {quote_value(file_path)} of {quote_value(path)}"

    def locate_file(key: str) -> Path | None:
        name = get_text(entry, key, title)
        find = partial(_find_any_case, listings=listings)
        return None if name is None else locate(path.parent, name, find)

    # Of nerfstudio, or of NeRFCapture.
    depth = locate_file("depth_file_path") or locate_file("depth_path")

    # A path of another machine: its longest end that exists here is taken, and becomes the name.
    image = None
    name = str(position)
    is_moved = False
    if file_path is not None:
        image = locate(path.parent, file_path, partial(find_image, listings=listings))
        endings = list_endings(file_path)
        is_moved = len(endings) > 1 and os.path.exists(image) and image != path.parent / file_path
        name = image.relative_to(path.parent).as_posix() if is_moved else file_path
    return replace(
        parse_camera_frame(entry, title, content),
        name=name,
        image=image,
        written=file_path if is_moved else None,
        depth=None if depth is None else partial(read_depth, depth, depth_unit),
        mask=locate_file("mask_path"),
    )


def parse_camera_frame(entry: Any, title: str, content: Mapping[str, Any] | None = None) -> Frame:
    """Parse the camera of a frame, with an exactly rigid pose, and none of the files it may name.

    The values of a frame take the place of those of the whole file, `content`.
    """
    c2w = get_array(entry, "transform_matrix", title, (3, 4), (4, 4))
    if len(c2w) == 3:
        c2w = np.vstack([c2w, [0, 0, 0, 1]])
    frame = Frame(title, title, c2w, _parse_intrinsics({**(content or {}), **entry}, title), None)
    frame = frame.with_rigid_pose(" (`transform_matrix`)")
    return replace(frame, c2w=frame.c2w @ OPENCV_FROM_OPENGL)


def _parse_intrinsics(entry: Mapping[str, Any], title: str) -> Intrinsics:
    def read_pair(
        x_key: str, y_key: str, low: float = -MAX_NUMBER, high: float = MAX_NUMBER
    ) -> NumberPair:
        x = get_optional_number(entry, x_key, title, low, high)
        y = get_optional_number(entry, y_key, title, low, high)
        return x, y

    focal = read_pair("fl_x", "fl_y", low=1 / MAX_NUMBER)
    angle = read_pair("camera_angle_x", "camera_angle_y", low=ANGLE_RANGE[0], high=ANGLE_RANGE[1])
    require(
        any(focal + angle),
        f"The focal length of {title} is missing; add `fl_x` and `fl_y`, or `camera_angle_x`.",
    )
    has_size = all(entry.get(key) is not None for key in "wh")
    size = get_size(entry, title, "w", "h") if has_size else None
    return Intrinsics(size, focal, read_pair("cx", "cy"), angle, _parse_distortion(entry, title))


def _parse_distortion(entry: Mapping[str, Any], title: str) -> Distortion:
    default = "OPENCV_FISHEYE" if entry.get("is_fisheye") else "OPENCV"
    model = default if entry.get("camera_model") is None else entry["camera_model"]
    known = PERSPECTIVE_MODELS + FISHEYE_MODELS
    advice = f"undistort the images first, or use one of {', '.join(known)}"
    if model == PANORAMA_MODEL:
        advice = PANORAMA_ADVICE
    require(
        model in known,
        f"The camera model '{quote_value(model)}' of {title} is not supported; {advice}.",
    )
    # Not all six are listed: files omit those that are zero.
    k1, k2, k3, k4, p1, p2 = (
        get_optional_number(entry, key, title, -MAX_COEFFICIENT, MAX_COEFFICIENT) or 0.0
        for key in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    if model in FISHEYE_MODELS:
        return Distortion("equidistant", radial=(k1, k2, k3, k4))
    require(
        k4 == 0,
        f"The coefficient k4 of {title} belongs to fisheye lenses, and its camera model is "
        f"{model}; set it to 0, or undistort the images first.",
    )
    return Distortion(radial=(k1, k2, k3), tangential=(p1, p2))


def write_transforms(path: Path, photographs: Photographs, home: Path) -> None:
    """Write the cameras of photographs as nerfstudio reads them; see `describe_transforms`."""
    content = describe_transforms(photographs, home)
    with replace_file(path) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def describe_transforms(photographs: Photographs, home: Path) -> dict[str, Any]:
    """Describe the cameras of the photographs that exist for nerfstudio, in their files' frame.

    Paths of photographs and masks are relative to `home`, the folder that the file is for, or
    absolute on another drive. Depth and points are not named. Raises InputError if no photograph
    exists, for photographs inside a container, masks whose white hides, lenses that the format does
    not have, and fisheye beside other lenses.
    """
    # A path with .. that passes a link leads to another place than its words say.
    home = Path(os.path.realpath(home))
    frames = [describe_frame(photographs.frame(number), home) for number in photographs.present]
    require(
        bool(frames),
        f"None of the photographs of {photographs.title} is there; put them where it names them.",
    )
    models = {frame["camera_model"] for frame in frames}
    require(
        len(models) == 1,
        f"The photographs of {photographs.title} have fisheye and other lenses, which programs do "
        "not read in one transforms.json; undistort the images first.",
    )
    return {"camera_model": models.pop(), "frames": frames}


def describe_frame(frame: Frame, home: Path) -> dict[str, Any]:
    """Describe a photograph and its camera, as `describe_transforms` does."""
    if frame.file is None or frame.file.path is None or frame.file.is_turned:
        raise InputError(
            f"The photograph of {frame.title} is no file of its own, which transforms.json cannot "
            "name; export the images first."
        )
    width, height = frame.size()
    pinhole = frame.intrinsics.compute_pinhole(width, height)
    content = {
        "file_path": find_path_from(home, frame.file.path),
        # The change of axes is its own inverse.
        "transform_matrix": (frame.c2w @ OPENCV_FROM_OPENGL).tolist(),
        "w": width,
        "h": height,
        "fl_x": pinhole.fl_x,
        "fl_y": pinhole.fl_y,
        "cx": pinhole.cx,
        "cy": pinhole.cy,
        **describe_distortion(frame),
    }
    if frame.mask is not None:
        require(
            not frame.has_inverted_mask,
            "The masks hide what is white, and other programs read them the other way round; "
            "invert the images, or leave out --invert-masks.",
        )
        content["mask_path"] = find_path_from(home, frame.mask)
    return content


def find_path_from(home: Path, path: Path) -> str:
    """Find the path of a file from the folder `home`, whose own path has no links.

    It is absolute where no relative one exists, on another drive of Windows.
    """
    # A photograph may be a link itself, whose own name is the one that the user knows.
    real = Path(os.path.realpath(path.parent), path.name)
    if real.drive != home.drive:
        return real.as_posix()
    return Path(os.path.relpath(real, home)).as_posix()


def describe_distortion(frame: Frame) -> dict[str, Any]:
    """Describe the lens of a photograph by the keys of nerfstudio."""
    lens = frame.intrinsics.distortion
    is_fisheye = lens.projection == "equidistant"
    is_known = is_fisheye or lens.projection == "perspective"
    num_radial = 4 if is_fisheye else 3
    has_more = any((*lens.denominator, *lens.prism, *lens.radial[num_radial:]))
    require(
        is_known and not has_more and not (is_fisheye and any(lens.tangential)),
        f"The lens of {frame.title} has a distortion that transforms.json does not hold; undistort "
        "the images first.",
    )
    radial = {f"k{number}": value for number, value in enumerate(lens.radial, start=1)}
    if is_fisheye:
        return {"camera_model": "OPENCV_FISHEYE", **radial}
    p1, p2 = lens.tangential
    return {"camera_model": "OPENCV", **radial, "p1": p1, "p2": p2}


def read_dataparser_transforms(path: Path) -> Float[np.ndarray, "4 4"]:
    """Read nerfstudio's similarity from the reconstruction's frame to that of the trained scene.

    The file holds a rigid 3×4 `transform` and a `scale` that multiplies its result.
    """
    content = read_json(path, "copy it from the folder of the nerfstudio run again")
    rigid = np.vstack([get_array(content, "transform", quote_value(path), (3, 4)), [0, 0, 0, 1]])
    defect = find_pose_defect(rigid)
    require(
        not defect,
        f"The `transform` of {quote_value(path)} cannot be used: {defect}; copy it again.",
    )
    scale = get_number(content, "scale", quote_value(path), *SCALE_RANGE)
    return np.diag([scale, scale, scale, 1.0]) @ rigid
