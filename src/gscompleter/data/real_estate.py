"""RealEstate10K camera files, and the camera rows they share with pixelSplat's chunks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import FRACTIONS, Intrinsics, invert_viewmat
from gscompleter.data.frame import Frame
from gscompleter.data.limits import require
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.errors import InputError
from gscompleter.io.reading import read_head, read_lines


def has_camera_files(path: Path) -> bool:
    """Check whether `path` is a RealEstate10K camera file, or a folder with some."""
    return bool(_list_camera_files(path))


def open_camera_files(path: Path) -> Iterator[Photographs]:
    """Open the photographs of each camera file that `path` is or holds, sorted by name."""
    return map(read_camera_file, _list_camera_files(path))


def read_camera_file(path: Path) -> Photographs:
    """Read a RealEstate10K camera file; the file names the scene.

    The first line is the address of the video. Each other line is a frame: timestamp, fx, fy, cx,
    cy in image widths and heights, two unused numbers, and the upper 3×4 of world-to-camera. The
    image is named after the timestamp and lies in a folder named after the file, or beside it.
    """
    lines = [line for line in read_lines(path) if line.strip()][1:]
    require(lines, f"{path} lists no frames; below the address, each frame needs a line.")
    frames = [_parse_frame(line, number, path) for number, line in enumerate(lines)]
    return build_photographs(path.stem, str(path), frames)


def parse_camera_row(
    numbers: Float[np.ndarray, "18"],
) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    """Split a row: fx, fy, cx, cy, two unused numbers, and the upper 3×4 of world-to-camera.

    The pose is camera-to-world, or the transform itself if it cannot be inverted.
    """
    fx, fy, cx, cy = numbers[:4].tolist()
    viewmat = np.vstack([numbers[6:].reshape(3, 4), [0, 0, 0, 1]])
    return Intrinsics(FRACTIONS, (fx, fy), (cx, cy)), invert_viewmat(viewmat)


def _parse_frame(line: str, number: int, path: Path) -> Frame:
    timestamp, *words = line.split()
    try:
        if not (timestamp.isascii() and timestamp.isdigit() and len(words) == 18):
            raise ValueError
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(
            f"Frame {number} of {path} is not a line of RealEstate10K, which has 19 numbers: "
            "timestamp, fx fy cx cy, 0 0, and 3 × 4 of world-to-camera; download it again."
        ) from error
    own = path.with_suffix("")
    folder = own if os.path.isdir(own) else path.parent
    intrinsics, c2w = parse_camera_row(numbers)
    title = f"frame {number} of {path}"
    return Frame(timestamp, title, c2w, intrinsics, folder / timestamp)


def _list_camera_files(path: Path) -> list[Path]:
    files = sorted(path.glob("*.txt")) if os.path.isdir(path) else [path]
    return [file for file in files if file.suffix == ".txt" and read_head(file, 4) == b"http"]
