"""COLMAP's binary files: cameras.bin, images.bin and points3D.bin.

Memory grows with what is read, not with the counts that a file claims.
"""

from __future__ import annotations

import mmap
import os
import struct
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
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
FEATURE_SIZE, SIGHTING_SIZE = 24, 8
"""Bytes of a feature (x, y, number of its point) and of a point's sighting (image, feature)."""


def read_cameras(path: Path) -> dict[int, Intrinsics]:
    """Read the cameras of a cameras.bin by number."""
    with _open_records(path) as records:
        return dict(_read_camera(records) for _ in range(records.read_count()))


def read_images(path: Path) -> list[PosedImage]:
    """Read the images of an images.bin in its order, without features."""
    with _open_records(path) as records:
        return [_read_image(records) for _ in range(records.read_count())]


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the points of a points3D.bin in scene units, without tracks."""
    coordinates = array("d")
    with _open_records(path) as records:
        for _ in range(records.read_count()):
            coordinates.extend(records.read("<Q3d3Bd")[1:4])
            records.skip(records.read_count() * SIGHTING_SIZE)
    return np.array(coordinates, dtype=np.float64).reshape(-1, 3)


def _read_camera(records: _Records) -> tuple[int, Intrinsics]:
    number, model_number, width, height = records.read("<IiQQ")
    title = f"camera {number} of {quote_value(records.path)}"
    model = find_model(model_number, title)
    numbers = records.read(f"<{len(model.parameters)}d")
    return number, build_intrinsics(model, (width, height), numbers, title)


def _read_image(records: _Records) -> PosedImage:
    _, *pose, camera = records.read("<I4d3dI")
    name = records.read_name()
    records.skip(records.read_count() * FEATURE_SIZE)
    return build_posed_image(name, camera, pose)


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
