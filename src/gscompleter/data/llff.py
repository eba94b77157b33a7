"""LLFF's `poses_bounds.npy`: poses, focal lengths and depth bounds without names.

A row is a 3×5 matrix and two numbers. The matrix columns are the camera axes down, right and back,
its centre, and height, width and focal length; the numbers are the smallest and largest z-depth of
the scene.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.frame import Frame, list_image_folders
from gscompleter.data.json_fields import get_size
from gscompleter.data.limits import DEPTH_RANGE, require
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.points import FAR_FACTOR, NEAR_FACTOR
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import check_file, list_entries

POSES_BOUNDS_FILE = "poses_bounds.npy"
LLFF_ENDINGS = (".jpg", ".jpeg", ".png")
LLFF_ADVICE = "run LLFF's imgs2poses again"


def has_llff(path: Path) -> bool:
    """Check whether `path` is a folder with a `poses_bounds.npy`, or a file whose name ends so."""
    return os.path.isfile(path / POSES_BOUNDS_FILE) or (
        path.name.endswith(POSES_BOUNDS_FILE) and os.path.isfile(path)
    )


def open_llff(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a `poses_bounds.npy`; its folder names the scene.

    Rows belong to the sorted photographs beside it, in `images` or another usual folder. The near
    and far planes enclose all bounds.
    """
    file = path / POSES_BOUNDS_FILE if os.path.isdir(path) else path
    rows = _read_pose_rows(file)
    images = _find_photographs(file, len(rows))
    frames = [
        _parse_llff_frame(image, row, f"row {number} of {quote_value(file)}")
        for number, (image, row) in enumerate(zip(images, rows, strict=True))
    ]
    near = NEAR_FACTOR * rows[:, 15].min().item()
    far = FAR_FACTOR * rows[:, 16].max().item()
    scene = build_photographs(file.parent.resolve().name, quote_value(file), frames)
    yield replace(scene, near=near, far=far)


def _parse_llff_frame(image: Path, row: Float[np.ndarray, "17"], title: str) -> Frame:
    down, right, back, center, (height, width, focal) = row[:15].reshape(3, 5).T
    size = get_size({"width": width, "height": height}, title)
    c2w = np.eye(4)
    # LLFF's axes are down, right and back; ours are right, down and forward.
    c2w[:3] = np.stack([right, down, -back, center], axis=1)
    intrinsics = Intrinsics(size, (float(focal), float(focal)))
    return Frame(image.name, title, c2w, intrinsics, image)


def _read_pose_rows(path: Path) -> Float[np.ndarray, "n 17"]:
    check_file(path)
    try:
        # Mapping refuses an array that claims more than the file holds.
        rows = np.load(path, mmap_mode="r").astype(np.float64, casting="same_kind")
    except Exception as error:  # damaged headers raise anything
        raise InputError(
            f"{quote_value(path)} is no array of real numbers; {LLFF_ADVICE}."
        ) from error
    require(
        rows.ndim == 2 and rows.shape[1] == 17 and len(rows) > 0,
        f"{quote_value(path)} has the shape {list(rows.shape)}, not 17 columns; {LLFF_ADVICE}.",
    )
    low, high = DEPTH_RANGE
    near = rows[:, 15]
    far = rows[:, 16]
    bounded = ((near >= low) & (near < far) & (far <= high)).all()
    require(
        bounded, f"The bounds in {quote_value(path)} are no z-depths, nearest first; {LLFF_ADVICE}."
    )
    return rows


def _find_photographs(file: Path, count: int) -> list[Path]:
    """List the photographs of the first folder with one for each row."""
    for folder in list_image_folders([file.parent]):
        images = [path for path in list_entries(folder) if path.suffix.lower() in LLFF_ENDINGS]
        if len(images) == count:
            return images
    raise InputError(
        f"{quote_value(file)} has {count} rows, one per photograph in order of their names; put "
        "exactly these photographs into a folder `images` beside it."
    )
