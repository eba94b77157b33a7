"""COLMAP's binary files: cameras.bin, images.bin and points3D.bin.

Claimed counts are compared with the file size before memory is allocated.
"""

from __future__ import annotations

import mmap
import os
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.colmap.records import (
    PosedImage,
    build_intrinsics,
    build_posed_image,
    find_model,
)
from gscompleter.errors import InputError, quote_value, refuse_pointer
from gscompleter.io.reading import open_file

MAX_NAME = 1024
"""Longest image name, in bytes."""

_COUNT = Struct("<Q")
_CAMERA = Struct("<IiQQ")
_IMAGE = Struct("<I4d3dI")
_FEATURE = Struct("<ddq")
_POINT = Struct("<Q3d3Bd")
_SIGHTING = Struct("<II")


def read_cameras(path: Path) -> dict[int, Intrinsics]:
    """Read the cameras of a cameras.bin by number."""
    with _open_records(path) as records:
        count = records.read_count(_CAMERA.size)
        return dict(_read_camera(records) for _ in range(count))


def read_images(path: Path) -> list[PosedImage]:
    """Read the images of an images.bin in its order, without features."""
    with _open_records(path) as records:
        count = records.read_count(_IMAGE.size + 1 + _COUNT.size)
        return [_read_image(records) for _ in range(count)]


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the points of a points3D.bin in scene units, without tracks."""
    coordinates = array("d")
    with _open_records(path) as records:
        for _ in range(records.read_count(_POINT.size + _COUNT.size)):
            coordinates.extend(records.read_numbers(_POINT)[1:4])
            records.skip(records.read_count(_SIGHTING.size) * _SIGHTING.size)
    return np.array(coordinates, dtype=np.float64).reshape(-1, 3)


def _read_camera(records: _Records) -> tuple[int, Intrinsics]:
    number, model_number, width, height = records.read_numbers(_CAMERA)
    title = f"camera {number} of {quote_value(records.path)}"
    model = find_model(model_number, title)
    numbers = records.read_numbers(Struct(f"<{len(model.parameters)}d"))
    return number, build_intrinsics(model, (width, height), numbers, title)


def _read_image(records: _Records) -> PosedImage:
    _, *pose, camera = records.read_numbers(_IMAGE)
    name = records.read_string()
    records.skip(records.read_count(_FEATURE.size) * _FEATURE.size)
    return build_posed_image(name, camera, pose)


@contextmanager
def _open_records(path: Path) -> Iterator[_Records]:
    refuse_pointer(path)
    with open_file(path) as file:
        if os.fstat(file.fileno()).st_size == 0:
            raise InputError(f"{quote_value(path)} is empty; export the model again.")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            yield _Records(content, path)


class _Records:
    """Bounds-checked sequential reader of a file."""

    def __init__(self, content: mmap.mmap, path: Path) -> None:
        self.content = content
        self.path = path
        self.position = 0

    def read_numbers(self, form: Struct) -> tuple[Any, ...]:
        start = self.position
        self.skip(form.size)
        return form.unpack_from(self.content, start)

    def read_count(self, smallest: int) -> int:
        """Read a count of records, each of at least `smallest` bytes."""
        (count,) = self.read_numbers(_COUNT)
        if count * smallest > len(self.content) - self.position:
            raise self._make_error()
        return int(count)

    def read_string(self) -> str:
        end = self.content.find(b"\0", self.position, self.position + MAX_NAME)
        if end < 0:
            raise self._make_error()
        text = os.fsdecode(self.content[self.position : end])
        self.position = end + 1
        return text

    def skip(self, size: int) -> None:
        if size > len(self.content) - self.position:
            raise self._make_error()
        self.position += size

    def _make_error(self) -> InputError:
        return InputError(
            f"{quote_value(self.path)} is truncated or no such file of COLMAP: it claims more "
            f"than its {len(self.content):,} bytes hold; export the model again."
        )
