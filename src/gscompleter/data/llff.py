"""LLFF's `poses_bounds.npy`: poses, focal lengths and depth bounds without names.

A row is a 3×5 matrix and two numbers. The columns of the matrix are the camera's axes down, right
and back, its centre, and height, width and focal length; the numbers are the z-depths between
which the scene lies.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tokenize import TokenError

import numpy as np
from jaxtyping import Float, Shaped

from gscompleter.data.frame import Frame
from gscompleter.data.image_folders import image_folders
from gscompleter.data.intrinsics import Intrinsics
from gscompleter.data.limits import DEPTH_RANGE, MAX_SIDE
from gscompleter.data.photographs import Photographs, photographs_of
from gscompleter.data.sparse_points import with_room
from gscompleter.errors import InputError, quoted
from gscompleter.reading import check_file

NAME = "poses_bounds.npy"
IMAGES = (".jpg", ".jpeg", ".png")
MAX_BYTES = 1 << 26
"""Of an array: as many as of half a million cameras."""

_NO_ARRAY = (ValueError, TypeError, EOFError, OverflowError, MemoryError, SyntaxError, TokenError)
"""What numpy raises for files that are no arrays, or are damaged ones."""


def holds_llff(path: Path) -> bool:
    """Whether `path` is a folder with a `poses_bounds.npy`, or such a file."""
    return os.path.isfile(path / NAME) or (path.name.endswith(NAME) and os.path.isfile(path))


def open_llff(path: Path) -> Iterator[Photographs]:
    """The photographs of a `poses_bounds.npy`, called by the name of its folder.

    The rows belong to the photographs beside it, in `images` or in one of the other folders of
    photographs, in the order of their sorted names. The near and far planes enclose all bounds.

    Raises:
        InputError: where the file is damaged, a camera impossible, or where there are not as many
            photographs as rows.
    """
    file = path / NAME if os.path.isdir(path) else path
    rows = _read_rows(file)
    images = _photographs_beside(file, len(rows))
    numbered = enumerate(zip(images, rows, strict=True))
    frames = [_frame(image, row, f"row {n} of {quoted(file)}") for n, (image, row) in numbered]
    near, far = with_room(float(rows[:, 15].min()), float(rows[:, 16].max()))
    scene = photographs_of(file.resolve().parent.name, str(file), frames)
    yield replace(scene, near=near, far=far)


def _frame(image: Path, row: Float[np.ndarray, "17"], title: str) -> Frame:
    down, right, back, center, (height, width, focal) = row[:15].reshape(3, 5).T
    if not all(1 <= side <= MAX_SIDE and side == int(side) for side in (height, width)):
        raise InputError(
            f"The {title} has an image of {width:g} × {height:g}; whole numbers of pixels from 1 "
            f"to {MAX_SIDE} are needed, so run LLFF's imgs2poses again."
        )
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, down, -back, center], axis=1)
    intrinsics = Intrinsics((int(width), int(height)), (float(focal), float(focal)))
    return Frame(image.name, title, c2w, intrinsics, image)


def _read_rows(path: Path) -> Float[np.ndarray, "n 17"]:
    stored = _stored_array(path)
    fitting = stored.ndim == 2 and stored.shape[1] == 17 and len(stored) > 0
    if not (fitting and stored.dtype.kind in "fiu" and stored.nbytes <= MAX_BYTES):
        raise InputError(
            f"{quoted(path)} holds {stored.dtype} of shape {list(stored.shape)}, where a row "
            "of 17 numbers for each photograph is needed; run LLFF's imgs2poses again."
        )
    rows = np.array(stored, dtype=np.float64)
    low, high = DEPTH_RANGE
    near, far = rows[:, 15], rows[:, 16]
    if not ((near >= low) & (near < far) & (far <= high)).all():
        raise InputError(
            f"The bounds in {quoted(path)} are no z-depths, nearest first, from {low:g} to "
            f"{high:g}; run LLFF's imgs2poses again."
        )
    return rows


def _stored_array(path: Path) -> Shaped[np.ndarray, "..."]:
    """The array as the file has it. One that claims more than the file holds is refused."""
    check_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.lib.format.open_memmap(path, mode="r")
    except OSError as error:
        raise InputError(f"{quoted(path)} cannot be read: {error}; correct the path.") from error
    except _NO_ARRAY as error:
        raise InputError(
            f"{quoted(path)} is no array of numbers ({quoted(str(error))}); run LLFF's "
            "imgs2poses again."
        ) from error


def _photographs_beside(file: Path, count: int) -> list[Path]:
    """The photographs of the first folder with as many as there are rows."""
    folders = image_folders([file.parent])
    found = [_images_in(folder) for folder in folders]
    fitting = next((images for images in found if len(images) == count), None)
    if fitting is None:
        numbers = ", ".join(f"{len(i)} in {f.name}" for f, i in zip(folders, found, strict=True))
        raise InputError(
            f"{quoted(file)} has {count} rows, which belong to as many photographs in order of "
            f"their names, and there are {numbers}; put exactly these into a folder "
            "`images` beside it."
        )
    return fitting


def _images_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGES)
