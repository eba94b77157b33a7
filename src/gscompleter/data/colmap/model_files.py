"""Files of a COLMAP model, binary and text: cameras, images and points3D.

Memory grows with what is read, not with the counts that a binary file claims. Other programs omit
the feature lines of text files or add empty ones, so lines are classified by content.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, compute_rotation, invert_viewmat
from gscompleter.data.limits import MAX_COEFFICIENT, MAX_NUMBER, MAX_SIDE
from gscompleter.data.undistort import Distortion, Projection
from gscompleter.errors import InputError, quote_value, refuse_pointer
from gscompleter.io.reading import open_file, read_lines

MAX_NAME = 1024
"""Longest image name in a binary file, in bytes."""
FEATURE_SIZE, SIGHTING_SIZE = 24, 8
"""Bytes of a feature (x, y, number of its point) and of a point's sighting (image, feature)."""
MAX_LINE = 1 << 22
"""Longest line in characters: the features of an image."""
MAX_BYTES = 1 << 34
"""Longest text file, in bytes."""


CameraEntry = tuple[int, str | int, tuple[int, int], Sequence[float]]
"""Number of a camera, name or number of its model, width and height, and parameters."""
Entry = TypeVar("Entry")


class PosedImage(NamedTuple):
    """An image of a model."""

    name: str
    """Path below the folder of photographs, with forward slashes."""
    camera: int
    c2w: Float[np.ndarray, "4 4"]
    """Camera-to-world in OpenCV axes; world-to-camera where that cannot be inverted."""


def build_posed_image(name: str, camera: int, numbers: Sequence[float]) -> PosedImage:
    """Build an image from world-to-camera: a quaternion, real part first, and a translation."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = compute_rotation(numbers[:4])
    viewmat[:3, 3] = numbers[4:]
    return PosedImage(name.replace("\\", "/"), camera, invert_viewmat(viewmat))


class Model(NamedTuple):
    """A camera model: its number in binary files, parameters and projection."""

    number: int
    names: str
    projection: Projection = "perspective"

    @property
    def parameters(self) -> list[str]:
        """Names of the parameters, in the order of the files."""
        return self.names.split()


MODELS = {
    "SIMPLE_PINHOLE": Model(0, "f cx cy"),
    "PINHOLE": Model(1, "fx fy cx cy"),
    "SIMPLE_RADIAL": Model(2, "f cx cy k1"),
    "RADIAL": Model(3, "f cx cy k1 k2"),
    "OPENCV": Model(4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": Model(5, "fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "FULL_OPENCV": Model(6, "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    "FOV": Model(7, "fx fy cx cy omega", "field-of-view"),
    "SIMPLE_RADIAL_FISHEYE": Model(8, "f cx cy k1", "equidistant"),
    "RADIAL_FISHEYE": Model(9, "f cx cy k1 k2", "equidistant"),
    "THIN_PRISM_FISHEYE": Model(10, "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3", "equidistant"),
    "SIMPLE_DIVISION": Model(12, "f cx cy k", "division"),
    "DIVISION": Model(13, "fx fy cx cy k", "division"),
    "SIMPLE_FISHEYE": Model(14, "f cx cy", "equidistant"),
    "FISHEYE": Model(15, "fx fy cx cy", "equidistant"),
    "EUCM": Model(16, "fx fy cx cy alpha beta", "unified"),
}
"""Models by COLMAP's names; k4 to k6 of FULL_OPENCV are d1 to d3, sx1 and sy1 are s1 and s3."""

NUMBERS = {model.number: name for name, model in MODELS.items()}
_SHAPES = ("omega", "k", "alpha", "beta")
_IN_PIXELS = ("f", "fx", "fy", "cx", "cy")


def find_model(name: str | int, title: str) -> Model:
    """Return the model of a name or number."""
    known = NUMBERS.get(name) if isinstance(name, int) else name
    if known not in MODELS:
        raise InputError(
            f"The camera model {quote_value(str(name))} of {title} is not supported; undistort the "
            "photographs with `colmap image_undistorter`, which writes a PINHOLE model."
        )
    return MODELS[known]


def build_intrinsics(
    model: Model, size: tuple[int, int], numbers: Sequence[float], title: str
) -> Intrinsics:
    """Build the intrinsics and distortion of a camera, and check their range."""
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise InputError(
            f"The size of {title} is {quote_value(size[0])} × {quote_value(size[1])}; sides from "
            f"1 to {MAX_SIDE} pixels are needed."
        )
    if len(numbers) != len(model.parameters):
        raise InputError(
            f"The model of {title} has the {len(model.parameters)} parameters {model.names}, and "
            f"{len(numbers)} are given; export the model again."
        )
    values = dict(zip(model.parameters, numbers, strict=True))
    for name, value in values.items():
        limit = MAX_NUMBER if name in _IN_PIXELS else MAX_COEFFICIENT
        if not abs(value) <= limit:
            raise InputError(
                f"The parameter {name} of {title} is {value:g}; a number of at most {limit:g} is "
                "needed."
            )

    shape, radial, denominator = (
        tuple(values[name] for name in names if name in values)
        for names in (_SHAPES, ("k1", "k2", "k3", "k4"), ("d1", "d2", "d3"))
    )
    tangential = values.get("p1", 0.0), values.get("p2", 0.0)
    prism = values.get("s1", 0.0), values.get("s3", 0.0)
    distortion = Distortion(model.projection, shape, radial, tangential, denominator, prism)
    focal = values.get("fx", values.get("f")), values.get("fy", values.get("f"))
    return Intrinsics(size, focal, (values["cx"], values["cy"]), distortion=distortion)


def read_cameras(path: Path) -> dict[int, Intrinsics]:
    """Read the cameras of a cameras.bin or cameras.txt by number."""
    if _is_text(path):
        found = _parse_lines(path, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS…", _parse_camera)
    else:
        found = _read_binary_cameras(path)
    cameras = {}
    for number, name, size, numbers in found:
        title = f"camera {number} of {quote_value(path)}"
        cameras[number] = build_intrinsics(find_model(name, title), size, numbers, title)
    return cameras


def read_images(path: Path) -> list[PosedImage]:
    """Read the images of an images.bin or images.txt in its order, without features."""
    if _is_text(path):
        form = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        return [image for image in _parse_lines(path, form, _parse_image) if image is not None]
    return list(_read_binary_images(path))


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the points of a points3D.bin or points3D.txt in scene units, without tracks."""
    if _is_text(path):
        found = _parse_lines(path, "POINT3D_ID X Y Z …", _parse_point)
    else:
        found = _read_binary_points(path)
    return np.fromiter(found, dtype=np.dtype((np.float64, 3)))


def _is_text(path: Path) -> bool:
    return path.suffix.lower() == ".txt"


def _read_binary_cameras(path: Path) -> Iterator[CameraEntry]:
    with _open_binary(path) as content:
        for _ in range(_read_count(content)):
            number, model, width, height = _unpack(content, "<IiQQ")
            title = f"camera {number} of {quote_value(path)}"
            count = len(find_model(model, title).parameters)
            yield number, model, (width, height), _unpack(content, f"<{count}d")


def _read_binary_images(path: Path) -> Iterator[PosedImage]:
    with _open_binary(path) as content:
        for _ in range(_read_count(content)):
            _, *pose, camera = _unpack(content, "<I4d3dI")
            name = _read_name(content)
            content.seek(_read_count(content) * FEATURE_SIZE, os.SEEK_CUR)
            yield build_posed_image(name, camera, pose)


def _read_binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    with _open_binary(path) as content:
        for _ in range(_read_count(content)):
            yield _unpack(content, "<Q3d3Bd")[1:4]
            content.seek(_read_count(content) * SIGHTING_SIZE, os.SEEK_CUR)


@contextmanager
def _open_binary(path: Path) -> Iterator[mmap.mmap]:
    """Map a file into memory; reading or seeking beyond its end becomes an InputError."""
    refuse_pointer(path)
    with open_file(path) as file:
        try:
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                yield content
        except InputError:
            raise
        except (struct.error, ValueError, OverflowError) as error:
            raise InputError(
                f"{quote_value(path)} is empty, truncated or no such file of COLMAP; export the "
                "model again."
            ) from error


def _unpack(content: mmap.mmap, form: str) -> tuple[Any, ...]:
    return struct.unpack(form, content.read(struct.calcsize(form)))


def _read_count(content: mmap.mmap) -> int:
    return int(_unpack(content, "<Q")[0])


def _read_name(content: mmap.mmap) -> str:
    start = content.tell()
    end = content.find(b"\0", start, start + MAX_NAME)
    if end < 0:
        raise ValueError("a name without an end")
    return os.fsdecode(content.read(end + 1 - start)[:-1])


def _parse_lines(path: Path, form: str, parse: Callable[[str], Entry]) -> Iterator[Entry]:
    """Parse the lines with content; a line without the words of `form` becomes an InputError."""
    # Names may have any encoding and are passed to the file system unchanged.
    lines = read_lines(path, MAX_LINE, MAX_BYTES, errors="surrogateescape")
    for number, line in enumerate(map(str.strip, lines), start=1):
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


def _parse_camera(line: str) -> CameraEntry:
    number, model, width, height, *words = line.split()
    return int(number), model, (int(width), int(height)), [float(word) for word in words]


def _parse_image(line: str) -> PosedImage | None:
    """Parse a pose and a name; None for the features X Y POINT3D_ID of an image."""
    words = line.split()
    if len(words) % 3 == 0 and words[-1].lstrip("-").isdecimal():
        return None
    _, qw, qx, qy, qz, x, y, z, camera, name = line.split(maxsplit=9)
    pose = [float(word) for word in (qw, qx, qy, qz, x, y, z)]
    return build_posed_image(name, int(camera), pose)


def _parse_point(line: str) -> tuple[float, ...]:
    _, x, y, z, *_ = line.split(maxsplit=4)
    return float(x), float(y), float(z)
