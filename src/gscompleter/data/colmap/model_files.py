"""Files of a COLMAP model, binary and text: cameras, images and points3D.

Memory grows with what is read, not with the counts that a binary file claims. Other programs omit
the feature lines of text files or add empty ones, so lines are classified by content.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, compute_rotation, invert_viewmat
from gscompleter.data.limits import MAX_COEFFICIENT, MAX_IN_PIXELS, MAX_SIDE
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
    values = dict(zip(model.parameters, numbers, strict=True))
    for name, value in values.items():
        limit = MAX_IN_PIXELS if name in _IN_PIXELS else MAX_COEFFICIENT
        if not abs(value) <= limit:
            raise InputError(
                f"The parameter {name} of {title} is {value:g}; a number of at most {limit:g} is "
                "needed."
            )

    def select(*names: str) -> tuple[float, ...]:
        return tuple(values[name] for name in names if name in values)

    distortion = Distortion(
        model.projection,
        shape=select(*_SHAPES),
        radial=select("k1", "k2", "k3", "k4"),
        tangential=(values.get("p1", 0.0), values.get("p2", 0.0)),
        denominator=select("d1", "d2", "d3"),
        prism=(values.get("s1", 0.0), values.get("s3", 0.0)),
    )
    focal = values.get("fx", values.get("f")), values.get("fy", values.get("f"))
    return Intrinsics(size, focal, (values["cx"], values["cy"]), distortion=distortion)


def read_cameras(path: Path) -> dict[int, Intrinsics]:
    """Read the cameras of a cameras.bin or cameras.txt by number."""
    read = _read_text_cameras if _is_text(path) else _read_binary_cameras
    return dict(read(path))


def read_images(path: Path) -> list[PosedImage]:
    """Read the images of an images.bin or images.txt in its order, without features."""
    read = _read_text_images if _is_text(path) else _read_binary_images
    return list(read(path))


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the points of a points3D.bin or points3D.txt in scene units, without tracks."""
    read = _read_text_points if _is_text(path) else _read_binary_points
    return np.fromiter(read(path), dtype=np.dtype((np.float64, 3)))


def _is_text(path: Path) -> bool:
    return path.suffix.lower() == ".txt"


def _read_binary_cameras(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    with _open_records(path) as records:
        for _ in range(records.read_count()):
            number, model_number, width, height = records.read("<IiQQ")
            title = f"camera {number} of {quote_value(path)}"
            model = find_model(model_number, title)
            numbers = records.read(f"<{len(model.parameters)}d")
            yield number, build_intrinsics(model, (width, height), numbers, title)


def _read_binary_images(path: Path) -> Iterator[PosedImage]:
    with _open_records(path) as records:
        for _ in range(records.read_count()):
            _, *pose, camera = records.read("<I4d3dI")
            name = records.read_name()
            records.skip(records.read_count() * FEATURE_SIZE)
            yield build_posed_image(name, camera, pose)


def _read_binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    with _open_records(path) as records:
        for _ in range(records.read_count()):
            yield records.read("<Q3d3Bd")[1:4]
            records.skip(records.read_count() * SIGHTING_SIZE)


@contextmanager
def _open_records(path: Path) -> Iterator[_Records]:
    refuse_pointer(path)
    with open_file(path) as file:
        try:
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                yield _Records(content, path)
        except InputError:
            raise
        except (struct.error, ValueError, OverflowError) as error:
            raise InputError(
                f"{quote_value(path)} is empty, truncated or no such file of COLMAP; export the "
                "model again."
            ) from error


class _Records:
    """Sequential reader of a file; a read beyond its end raises an error of struct or mmap."""

    def __init__(self, content: mmap.mmap, path: Path) -> None:
        self.content = content
        self.path = path

    def read(self, form: str) -> tuple[Any, ...]:
        return struct.unpack(form, self.content.read(struct.calcsize(form)))

    def read_count(self) -> int:
        return int(self.read("<Q")[0])

    def read_name(self) -> str:
        start = self.content.tell()
        end = self.content.find(b"\0", start, start + MAX_NAME)
        if end < 0:
            raise ValueError("a name without an end")
        name = os.fsdecode(self.content.read(end - start))
        self.skip(1)
        return name

    def skip(self, size: int) -> None:
        self.content.seek(size, os.SEEK_CUR)


def _read_text_cameras(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    for line, place in _read_content_lines(path):
        with _name_line(place, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS…"):
            number, name, width, height, *words = line.split()
            size, numbers = (int(width), int(height)), [float(word) for word in words]
            title = f"camera {int(number)} of {place}"
        model = find_model(name, title)
        if len(numbers) != len(model.parameters):
            raise InputError(
                f"The model {name} of {title} has the {len(model.parameters)} parameters "
                f"{' '.join(model.parameters)}, and {len(numbers)} are given; export the model "
                "again."
            )
        yield int(number), build_intrinsics(model, size, numbers, title)


def _read_text_images(path: Path) -> Iterator[PosedImage]:
    for line, place in _read_content_lines(path):
        if _has_features(line):
            continue
        with _name_line(place, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
            _, qw, qx, qy, qz, x, y, z, camera, name = line.split(maxsplit=9)
            pose = [float(word) for word in (qw, qx, qy, qz, x, y, z)]
            image = build_posed_image(name.strip(), int(camera), pose)
        yield image


def _read_text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for line, place in _read_content_lines(path):
        with _name_line(place, line, "POINT3D_ID X Y Z …"):
            _, x, y, z, *_ = line.split(maxsplit=4)
            point = float(x), float(y), float(z)
        yield point


def _has_features(line: str) -> bool:
    """Check whether a line holds triples X Y POINT3D_ID instead of a pose and a name."""
    words = line.split()
    return len(words) % 3 == 0 and words[-1].lstrip("-").isdecimal()


def _read_content_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the lines with content, each with its location."""
    # Names may have any encoding and are passed to the file system unchanged.
    lines = read_lines(path, MAX_LINE, MAX_BYTES, errors="surrogateescape")
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield line, f"line {number} of {quote_value(path)}"


@contextmanager
def _name_line(place: str, line: str, form: str) -> Iterator[None]:
    """Name the line that lacks the words of a form or has others in place of numbers."""
    try:
        yield
    except ValueError as error:
        raise InputError(
            f"The {place} is '{quote_value(line.strip())}', where {form} is needed; export the "
            "model again."
        ) from error
