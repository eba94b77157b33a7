"""Photographs with a COLMAP model, binary or text, in common folder layouts.

A model is a folder with a reconstruction; the model of a camera is always a `CameraModel` here.
Memory grows with what is read, not with the counts that a binary file claims. Other programs omit
the feature lines of text files or add empty ones, so lines are classified by content.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import (
    PANORAMA_ADVICE,
    PANORAMA_MODEL,
    Distortion,
    Intrinsics,
    Projection,
    compute_rotation,
    invert_viewmat,
)
from gscompleter.data.depth_beside_colmap import attach_depth_maps
from gscompleter.data.file_names import is_photograph_name
from gscompleter.data.frame import (
    Frame,
    find_file,
    find_path,
    keep_existing,
    list_image_folders,
    locate_images,
)
from gscompleter.data.limits import MAX_COEFFICIENT, MAX_NUMBER
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.points import read_point_cloud
from gscompleter.system.errors import InputError, quote_value, refuse_pointer
from gscompleter.system.files.reading import list_entries, open_file, read_lines
from gscompleter.types import MAX_IMAGE_SIDE

MODEL_HOMES = ("sparse", "colmap/sparse", "distorted/sparse", "")
"""Folders that are models or hold numbered ones, in search order."""

MODEL_ENDINGS = (".bin", ".txt")
"""Endings of the files of a model, the preferred one first."""

MAX_NAME = 1024
"""Longest image name in a binary file, in bytes."""
UNIT_TOLERANCE = 1e-3
"""Largest deviation of the length of a quaternion from 1, by which it is known as one."""
FEATURE_SIZE = 24
"""Bytes of a feature: x, y and the number of its point."""
MAX_FEATURES_LINE = 1 << 22
"""Longest line of a text file, in characters: the features of an image."""
MAX_MODEL_BYTES = 1 << 34
"""Largest text file, in bytes."""

CameraEntry = tuple[int, str | int, tuple[int, int], Sequence[float]]
"""Number of a camera, name or number of its camera model, width and height, and parameters."""
Track = tuple[tuple[float, ...], list[int]]
"""Position of a point, and the numbers of the images that show it."""
Entry = TypeVar("Entry")


class PosedImage(NamedTuple):
    """An image of a model."""

    number: int
    name: str
    """Path below the folder of photographs, with forward slashes."""
    camera: int
    c2w: Float[np.ndarray, "4 4"]
    """Camera-to-world in OpenCV axes. An invalid pose stays world-to-camera: all that is asked of
    it later is its defect."""


def build_posed_image(number: int, name: str, camera: int, numbers: Sequence[float]) -> PosedImage:
    """Build an image from world-to-camera: a quaternion, real part first, and a translation."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = compute_rotation(numbers[:4])
    viewmat[:3, 3] = numbers[4:]
    return PosedImage(number, name.replace("\\", "/"), camera, invert_viewmat(viewmat))


class CameraModel(NamedTuple):
    """A camera model of COLMAP."""

    number: int
    """Its number in binary files."""
    parameters: str
    """Names of the parameters, in the order of the files."""
    projection: Projection = "perspective"


CAMERA_MODELS = {
    "SIMPLE_PINHOLE": CameraModel(0, "f cx cy"),
    "PINHOLE": CameraModel(1, "fx fy cx cy"),
    "SIMPLE_RADIAL": CameraModel(2, "f cx cy k1"),
    "RADIAL": CameraModel(3, "f cx cy k1 k2"),
    "OPENCV": CameraModel(4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": CameraModel(5, "fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "FULL_OPENCV": CameraModel(6, "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    "FOV": CameraModel(7, "fx fy cx cy omega", "field-of-view"),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(8, "f cx cy k1", "equidistant"),
    "RADIAL_FISHEYE": CameraModel(9, "f cx cy k1 k2", "equidistant"),
    "THIN_PRISM_FISHEYE": CameraModel(10, "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3", "equidistant"),
    "SIMPLE_DIVISION": CameraModel(12, "f cx cy k", "division"),
    "DIVISION": CameraModel(13, "fx fy cx cy k", "division"),
    "SIMPLE_FISHEYE": CameraModel(14, "f cx cy", "equidistant"),
    "FISHEYE": CameraModel(15, "fx fy cx cy", "equidistant"),
    "EUCM": CameraModel(16, "fx fy cx cy alpha beta", "unified"),
}
"""Camera models by COLMAP's names, without those of `UNREAD_CAMERA_MODELS`. k4 to k6 of FULL_OPENCV
are d1 to d3, and sx1 and sy1 are s1 and s3."""

UNREAD_CAMERA_MODELS = {11: "RAD_TAN_THIN_PRISM_FISHEYE", 17: PANORAMA_MODEL}
"""Names of COLMAP's other camera models, by number."""

CAMERA_MODEL_NAMES = UNREAD_CAMERA_MODELS | {
    model.number: name for name, model in CAMERA_MODELS.items()
}

_IN_PIXELS = ("f", "fx", "fy", "cx", "cy")
"""Parameters in pixels; the others have no unit."""


def get_camera_model(name: str | int, title: str) -> CameraModel:
    """Return the camera model of a name or number; `title` names the camera in errors."""
    known = CAMERA_MODEL_NAMES.get(name, str(name)) if isinstance(name, int) else name
    if known in CAMERA_MODELS:
        return CAMERA_MODELS[known]
    advice = (
        "undistort the photographs with `colmap image_undistorter`, which writes a PINHOLE model"
    )
    if known == PANORAMA_MODEL:
        # That command refuses panoramas.
        advice = PANORAMA_ADVICE
    raise InputError(
        f"The camera model {quote_value(known)} of {title} is not supported; {advice}."
    )


def build_intrinsics(
    model: CameraModel, size: tuple[int, int], numbers: Sequence[float], title: str
) -> Intrinsics:
    """Build the intrinsics and distortion of a camera, and check their range.

    `size` is width and height, `numbers` are the parameters; `title` names the camera in errors.
    """
    if not all(1 <= side <= MAX_IMAGE_SIDE for side in size):
        raise InputError(
            f"The size of {title} is {quote_value(size[0])} × {quote_value(size[1])}; sides from "
            f"1 to {MAX_IMAGE_SIDE} pixels are needed."
        )
    names = model.parameters.split()
    if len(numbers) != len(names):
        raise InputError(
            f"The model of {title} has the {len(names)} parameters {model.parameters}, and "
            f"{len(numbers)} are given; export the model again."
        )
    values = dict(zip(names, numbers, strict=True))
    for name, value in values.items():
        limit = MAX_NUMBER if name in _IN_PIXELS else MAX_COEFFICIENT
        if not abs(value) <= limit:
            raise InputError(
                f"The parameter {name} of {title} is {value:g}; a number of at most {limit:g} is "
                "needed."
            )

    def select(*group: str) -> tuple[float, ...]:
        return tuple(values[name] for name in group if name in values)

    shape = select("omega", "k", "alpha", "beta")
    radial = select("k1", "k2", "k3", "k4")
    denominator = select("d1", "d2", "d3")
    tangential = values.get("p1", 0.0), values.get("p2", 0.0)
    prism = values.get("s1", 0.0), values.get("s3", 0.0)
    distortion = Distortion(model.projection, shape, radial, tangential, denominator, prism)
    # Models with one focal length call it f.
    focal = values.get("fx", values.get("f")), values.get("fy", values.get("f"))
    return Intrinsics(size, focal, (values["cx"], values["cy"]), distortion=distortion)


def read_intrinsics(path: Path) -> dict[int, Intrinsics]:
    """Read the cameras of a cameras.bin or cameras.txt by number."""
    if _is_text(path):
        entries = _parse_lines(path, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS…", _parse_camera_line)
    else:
        entries = _read_binary_cameras(path)
    cameras = {}
    for number, name, size, numbers in entries:
        title = f"camera {number} of {quote_value(path)}"
        cameras[number] = build_intrinsics(get_camera_model(name, title), size, numbers, title)
    return cameras


def read_images(path: Path) -> list[PosedImage]:
    """Read the images of an images.bin or images.txt in its order, without features."""
    if _is_text(path):
        form = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        return [image for image in _parse_lines(path, form, _parse_image) if image is not None]
    return list(_read_binary_images(path))


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the points of a points3D.bin or points3D.txt in scene units."""
    # A generator fills the array, since a list of tuples takes several times its memory.
    return np.fromiter((xyz for xyz, _ in _read_tracks(path)), dtype=np.dtype((np.float64, 3)))


@lru_cache(maxsize=1)
def read_seen_points(path: Path, changed: int) -> dict[int, Float[np.ndarray, "n 3"]]:
    """Read the points that each image shows, in scene units, by the number of the image.

    `changed`, the time of the last change of the file, is a key of the cache: a file that is
    written anew is read anew.
    """
    # A point may be seen by two features of one image, and counts once there.
    sightings = [(image, xyz) for xyz, images in _read_tracks(path) for image in set(images)]
    sightings.sort(key=lambda one: one[0])
    return {
        image: np.array([xyz for _, xyz in group])
        for image, group in groupby(sightings, key=lambda one: one[0])
    }


def _read_tracks(path: Path) -> Iterator[Track]:
    """Read the points of a model with the images that show them."""
    if _is_text(path):
        return _parse_lines(path, "POINT3D_ID X Y Z …", _parse_point)
    return _read_binary_points(path)


def _is_text(path: Path) -> bool:
    return path.suffix.lower() == ".txt"


def _read_binary_cameras(path: Path) -> Iterator[CameraEntry]:
    with _open_binary(path) as content:
        for _ in range(_read_count(content)):
            number, model, width, height = _unpack_struct(content, "<IiQQ")
            title = f"camera {number} of {quote_value(path)}"
            count = len(get_camera_model(model, title).parameters.split())
            yield number, model, (width, height), _unpack_struct(content, f"<{count}d")


def _read_binary_images(path: Path) -> Iterator[PosedImage]:
    with _open_binary(path) as content:
        for _ in range(_read_count(content)):
            number, *pose, camera = _unpack_struct(content, "<I4d3dI")
            # The name ends with a zero byte.
            start = content.tell()
            end = content.find(b"\0", start, start + MAX_NAME + 1)
            if end < 0:
                raise ValueError("a name without an end")
            name = os.fsdecode(content.read(end + 1 - start)[:-1])
            # Features take most of the file and are not needed.
            content.seek(_read_count(content) * FEATURE_SIZE, os.SEEK_CUR)
            yield build_posed_image(number, name, camera, pose)


def _read_binary_points(path: Path) -> Iterator[Track]:
    with _open_binary(path) as content:
        for _ in range(_read_count(content)):
            # Between the position and the length of its track, a point has a colour and an error.
            xyz = _unpack_struct(content, "<Q3d3Bd")[1:4]
            # A track is pairs of the numbers of an image and of a feature in it.
            track = _unpack_struct(content, f"<{2 * _read_count(content)}I")
            yield xyz, list(track[::2])


@contextmanager
def _open_binary(path: Path) -> Iterator[mmap.mmap]:
    """Map a file into memory; reading or seeking beyond its end becomes an InputError."""
    refuse_pointer(path)
    with open_file(path) as file:
        try:
            # A mapped file needs no memory for what is skipped.
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                yield content
        except InputError:
            raise
        except (struct.error, ValueError, OverflowError) as error:
            raise InputError(
                f"{quote_value(path)} is empty, truncated or no such file of COLMAP; export the "
                "model again."
            ) from error


def _unpack_struct(content: mmap.mmap, form: str) -> tuple[Any, ...]:
    return struct.unpack(form, content.read(struct.calcsize(form)))


def _read_count(content: mmap.mmap) -> int:
    return int(_unpack_struct(content, "<Q")[0])


def _parse_lines(path: Path, form: str, parse: Callable[[str], Entry]) -> Iterator[Entry]:
    """Parse the lines with content; a line without the words of `form` becomes an InputError."""
    # Names may have any encoding and are passed to the file system unchanged.
    lines = read_lines(path, MAX_FEATURES_LINE, MAX_MODEL_BYTES, errors="surrogateescape")
    for number, raw_line in enumerate(lines, start=1):
        line = raw_line.strip()
        if not line or line.startswith("#"):
            continue
        try:
            entry = parse(line)
        except ValueError as error:
            raise InputError(
                f"The line {number} of {quote_value(path)} is '{quote_value(line)}', where {form} "
                "is needed; export the model again."
            ) from error
        yield entry


def _parse_camera_line(line: str) -> CameraEntry:
    number, model, width, height, *words = line.split()
    return int(number), model, (int(width), int(height)), [float(word) for word in words]


def _parse_image(line: str) -> PosedImage | None:
    """Parse a pose and a name; None for the features of an image."""
    if _holds_features(line.split()):
        return None
    # A name may hold spaces.
    number, qw, qx, qy, qz, x, y, z, camera, name = line.split(maxsplit=9)
    pose = [float(word) for word in (qw, qx, qy, qz, x, y, z)]
    return build_posed_image(int(number), name, int(camera), pose)


def _holds_features(words: Sequence[str]) -> bool:
    """Check whether a line of images.txt holds features, triples X Y POINT3D_ID, and no pose."""
    # The number of a point is whole, and -1 for none. In a pose qx and tx stand at such places.
    places = (*words[2:12:3], words[-1])
    if len(words) % 3 != 0 or not all(word.lstrip("-").isdecimal() for word in places):
        return False
    # A pose has nine numbers and a name. Words of a name such as "IMG 1 2" are no feature.
    try:
        numbers = [float(word) for word in words[:12]]
    except ValueError:
        return False
    # What is left may still be a pose of whole numbers, as that of a first image often is, and a
    # name of three numbers, such as "2024 05 01". Its quaternion has the length 1. Between two
    # features, in pixels, the same four numbers do not.
    is_posed = len(numbers) == 12 and abs(math.hypot(*numbers[1:5]) - 1) < UNIT_TOLERANCE
    return not (is_posed and numbers[0] >= 0 and numbers[8] >= 0)


def _parse_point(line: str) -> Track:
    _, x, y, z, *rest = line.split()
    # After the position: colour (3) and error, then pairs of image and feature.
    return (float(x), float(y), float(z)), [int(image) for image in rest[4::2]]


def has_colmap(path: Path) -> bool:
    """Check whether `path` is a scene with a COLMAP model, a model, or its images file."""
    return bool(_find_image_files(path))


def open_colmap(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a scene, of one model, or of its images file, as a single scene.

    The model with most images is used, and the topmost folder of the scene gives the name. Frames
    are numbered by the sorted names of the photographs that exist.
    """
    model, frames, notes = _select_largest(path)
    roots = _list_roots(path.parent if is_image_file(path) else path, model)
    existing, missing_notes = keep_existing(locate_images(frames, roots), quote_value(model))
    existing, depth_notes = attach_depth_maps(existing, roots, model)
    notes += (*missing_notes, *depth_notes, *_describe_orientation(existing[0]))
    photographs = build_photographs(roots[-1].name, quote_value(model), existing)
    yield replace(photographs, notes=notes, sparse=_make_model_point_reader(model))


def _describe_orientation(frame: Frame) -> tuple[str, ...]:
    """Describe what becomes of the EXIF rotation of the first photograph, if it has one."""
    if frame.file is None or frame.file.orientation == 1:
        return ()
    if frame.find_turn() != 1:
        return ("Photographs are turned as EXIF asks, because their cameras are upright.",)
    return ("EXIF rotation is ignored: photographs are used as they are stored.",)


def read_scene_cameras(path: Path) -> list[Frame]:
    """Read the cameras of a scene's largest model in its order, with the photographs that exist.

    `path` is the folder of the scene or of the model.
    """
    model, frames, _ = _select_largest(path)
    return locate_images(frames, _list_roots(path, model))


def _select_largest(path: Path) -> tuple[Path, list[Frame], tuple[str, ...]]:
    """Read the model of a scene with most images: its folder, frames, and notes on others."""
    # A mapper that cannot connect all photographs writes several models, sparse/0, sparse/1, …
    models = [(images.parent, read_image_file(images)) for images in _find_image_files(path)]
    if not models:
        raise InputError(
            f"There is no COLMAP model in {quote_value(path)}; a folder sparse/0 with its cameras "
            "and images, as .bin or .txt, is needed."
        )
    model, frames = max(models, key=lambda one: len(one[1]))
    if len(models) == 1:
        return model, frames, ()
    # Only the first one may be the home of the others itself.
    home = models[-1][0].parent
    used = "the one in the folder itself" if model == home else quote_value(model.name)
    note = (
        f"{len(models)} models lie in {quote_value(home)}: {used} with {len(frames)} images is "
        "used; the others are ignored."
    )
    return model, frames, (note,)


def is_image_file(path: Path) -> bool:
    """Check whether `path` is the images file of a COLMAP model."""
    name = path.name.casefold()
    return name in {f"images{ending}" for ending in MODEL_ENDINGS} and os.path.isfile(path)


def _find_image_files(path: Path) -> list[Path]:
    """List the images files of a scene's models, all from the first of `MODEL_HOMES` with any."""
    if is_image_file(path):
        return [path]
    if not os.path.isdir(path):
        return []
    for name in MODEL_HOMES:
        home = find_path(path, name)
        if home is None or not os.path.isdir(home):
            continue
        # A home may be a model itself, or hold numbered ones.
        numbered = sorted(entry for entry in os.listdir(home) if entry.isdecimal())
        folders = [home, *(home / entry for entry in numbered)]
        candidates = [_find_model_file(folder, "images") for folder in folders]
        image_files = [
            images for images in candidates if images and _find_model_file(images.parent, "cameras")
        ]
        if image_files:
            return image_files
    return []


def _find_model_file(folder: Path, name: str) -> Path | None:
    """Find a file of a model, preferring binary; None if there is none."""
    return find_file([folder], [name + ending for ending in MODEL_ENDINGS])


def read_image_file(path: Path) -> list[Frame]:
    """Read the frames of an images.txt or images.bin in its order, with the cameras file beside it.

    They have cameras, but no photographs yet. `rigs` and `frames` (COLMAP 3.12) beside it add
    nothing to the poses.
    """
    cameras_file = _find_model_file(path.parent, "cameras")
    if cameras_file is None:
        raise InputError(
            f"There is no cameras.txt or cameras.bin beside {quote_value(path)}, and it holds "
            "poses only; copy it there from the same model."
        )
    cameras = read_intrinsics(cameras_file)
    images = read_images(path)
    if not images:
        raise InputError(f"{quote_value(path)} lists no images; export the model again.")
    if len({image.name for image in images}) < len(images):
        raise InputError(f"{quote_value(path)} lists an image twice; export the model again.")
    lacking = {image.camera for image in images} - cameras.keys()
    if lacking:
        raise InputError(
            f"Images in {quote_value(path)} were taken by camera {min(lacking)}, which is not in "
            "the cameras file beside it; export the model again."
        )
    points = _find_model_file(path.parent, "points3D")

    def make_frame(image: PosedImage) -> Frame:
        title = f"image {quote_value(image.name)} of {quote_value(path)}"
        seen = None if points is None else partial(_find_seen_points, points, image.number)
        intrinsics = cameras[image.camera]
        return Frame(image.name, title, image.c2w, intrinsics, None, seen_points=seen)

    return [make_frame(image) for image in images]


def _find_seen_points(path: Path, number: int) -> Float[np.ndarray, "n 3"]:
    """Find the points of a file that an image shows, by its number, in scene units."""
    seen = read_seen_points(path, path.stat().st_mtime_ns)
    return seen.get(number, np.zeros((0, 3)))


def _list_roots(scene: Path, model: Path) -> list[Path]:
    """List the folders that may hold photographs: from the model up to the folder of the scene.

    A user may give a folder inside of a scene. The scene is then above all folders that bear the
    name of a home of models, such as room of room/sparse/0.
    """
    given = Path(os.path.abspath(scene))
    roots = [Path(os.path.abspath(model))]
    home_names = {part for home in MODEL_HOMES if home for part in home.split("/")}
    # A numbered model, 0, lies in a home of models. Scene 360 may lie in a folder of that name, but
    # has photographs, or its model is below it.
    is_numbered = roots[0].name.isdecimal() and not _holds_photographs(roots[0])
    while True:
        folder = roots[-1]
        is_below_given = given in folder.parents
        home = folder.parent if is_numbered and len(roots) == 1 else folder
        if not is_below_given and home.name.casefold() not in home_names:
            return roots
        roots.append(folder.parent)


def _holds_photographs(folder: Path) -> bool:
    """Check whether photographs lie in a folder, or in one of the usual folders below it."""
    *image_folders, _ = list_image_folders([folder])
    return bool(image_folders) or any(
        is_photograph_name(path.name) for path in list_entries(folder)
    )


def _make_model_point_reader(model: Path) -> partial[Float[np.ndarray, "n 3"]] | None:
    """Return a reader of the model's points, in scene units; None if it has no file of points."""
    path = _find_model_file(model, "points3D")
    if path is not None:
        return partial(read_points, path)
    # The script of 3DGS writes them as PLY.
    cloud = find_path(model, "points3D.ply")
    return None if cloud is None else partial(read_point_cloud, cloud)
