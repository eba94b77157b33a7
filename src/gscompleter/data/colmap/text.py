"""COLMAP's text files: cameras.txt, images.txt and points3D.txt.

Other programs omit the feature lines or add empty ones, so lines are classified by content.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.colmap.records import (
    PosedImage,
    build_intrinsics,
    build_posed_image,
    find_model,
)
from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import read_lines

MAX_LINE = 1 << 22
"""Longest line in characters: the features of an image."""
MAX_BYTES = 1 << 34
"""Longest file, in bytes."""


def read_cameras(path: Path) -> dict[int, Intrinsics]:
    """Read the cameras of a cameras.txt by number."""
    return dict(_parse_camera(line, place) for line, place in _read_content_lines(path))


def read_images(path: Path) -> list[PosedImage]:
    """Read the images of an images.txt in its order, without features."""
    return [
        _parse_image(line, place)
        for line, place in _read_content_lines(path)
        if not _has_features(line)
    ]


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the points of a points3D.txt in scene units, without tracks."""
    coordinates = array("d")
    for line, place in _read_content_lines(path):
        try:
            _, x, y, z, *_ = line.split(maxsplit=4)
            coordinates.extend((float(x), float(y), float(z)))
        except ValueError as error:
            raise _make_error(place, line, "POINT3D_ID X Y Z …") from error
    return np.array(coordinates, dtype=np.float64).reshape(-1, 3)


def _parse_camera(line: str, place: str) -> tuple[int, Intrinsics]:
    try:
        number, name, width, height, *words = line.split()
        size, numbers = (int(width), int(height)), [float(word) for word in words]
        title = f"camera {int(number)} of {place}"
    except ValueError as error:
        raise _make_error(place, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS…") from error
    model = find_model(name, title)
    if len(numbers) != len(model.parameters):
        raise InputError(
            f"The model {name} of {title} has the {len(model.parameters)} parameters "
            f"{' '.join(model.parameters)}, and {len(numbers)} are given; export the model again."
        )
    return int(number), build_intrinsics(model, size, numbers, title)


def _parse_image(line: str, place: str) -> PosedImage:
    try:
        *words, camera, name = line.split(maxsplit=9)
        _, *pose = (float(word) for word in words)
        if len(pose) != 7:
            raise ValueError
        return build_posed_image(name.strip(), int(camera), pose)
    except ValueError as error:
        form = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        raise _make_error(place, line, form) from error


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


def _make_error(place: str, line: str, form: str) -> InputError:
    return InputError(
        f"The {place} is '{quote_value(line.strip())}', where {form} is needed; export the model "
        "again."
    )
