"""KITTI odometry: a file of poses, and a file of calibrations of the rectified cameras.

A pose is the upper 3×4 of camera-to-world of camera 0, in OpenCV axes, a line a frame. A
calibration is the 3×4 projection of each camera from the frame of camera 0: its intrinsics, and
how far the camera stands aside. Where it has `Tr`, the pose of the laser, sweeps in the folder
`velodyne` give sparse depth.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.frame import Frame
from gscompleter.data.intrinsics import Intrinsics
from gscompleter.data.photographs import Photographs, photographs_of
from gscompleter.data.poses import pose_defect
from gscompleter.data.velodyne import read_sweep
from gscompleter.errors import InputError, quoted
from gscompleter.reading import MAX_LINE, read_head, read_lines

POSES, CALIBRATION = "poses.txt", "calib.txt"
CAMERAS = {"image_2": 2, "image_0": 0, "image_3": 3, "image_1": 1, "image_l": 0, "image_r": 1}
"""Folders of photographs, in the order in which they are looked for, and whose they are."""
LARGEST = 1e12
"""Of the numbers of a matrix."""


def holds_kitti(path: Path) -> bool:
    """Whether `path` is a sequence of KITTI odometry, or a file of poses."""
    if os.path.isdir(path):
        return os.path.isfile(path / CALIBRATION) and _poses_of(path) is not None
    return path.suffix == ".txt" and os.path.isfile(path) and _begins_with_a_pose(path)


def open_kitti(path: Path) -> Iterator[Photographs]:
    """The photographs of a sequence, called by the name of its folder.

    The colour camera on the left (2) is taken where its photographs are there, else one of the
    others. Frames are numbered in the order of the poses.

    Args:
        path: A folder with calib.txt and with poses.txt, or with its poses in ../../poses; or a
            file of poses, whose calibration and photographs lie beside it or in ../sequences.

    Raises:
        InputError: where a file is missing or damaged, or there are no photographs.
    """
    poses = _poses_of(path) if os.path.isdir(path) else path
    if poses is None:
        raise InputError(f"There are no poses in {quoted(path)}; put {POSES} into it.")
    folder = path if os.path.isdir(path) else _sequence_of(path)
    calibration = _calibration_beside(folder, poses)
    images, camera = _camera_folder(folder)
    intrinsics, first_from_camera = _camera(calibration, camera)
    first_from_laser = _laser(calibration)
    frames = []
    for number, first in enumerate(_matrices(poses)):
        frame = _frame(number, first @ first_from_camera, intrinsics, images, poses)
        sweep = folder / "velodyne" / f"{number:06d}.bin"
        if first_from_laser is not None and os.path.isfile(sweep):
            measured = partial(read_sweep, sweep, first @ first_from_laser)
            frame = replace(frame, measured=measured)
        frames.append(frame)
    yield photographs_of(folder.resolve().name, str(poses), frames)


def _frame(
    number: int, c2w: Float[np.ndarray, "4 4"], intrinsics: Intrinsics, images: Path, poses: Path
) -> Frame:
    name = f"{number:06d}"
    title = f"frame {number} of {quoted(poses)}"
    return Frame(name, title, c2w, intrinsics, images / name)


def _camera(calibration: Path, camera: int) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    """The intrinsics of a camera, and the transform from its frame to that of camera 0."""
    projections = _matrices(calibration)
    if len(projections) <= camera:
        raise InputError(
            f"{quoted(calibration)} has {len(projections)} projections, and the photographs are "
            f"those of camera {camera}; a line P{camera} is needed."
        )
    return rectified(projections[camera], camera, str(calibration))


def rectified(
    projection: Float[np.ndarray, "4 4"], camera: int, title: str
) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    """The intrinsics of a rectified camera, and the transform from its frame to that of camera 0.

    Raises:
        InputError: where its projection, from the frame of camera 0, is that of no such camera.
    """
    K, aside = projection[:3, :3], projection[:3, 3]
    if not _is_upright(K):
        raise InputError(
            f"The projection of camera {camera} in {title} is none of a rectified "
            "camera; name the calib.txt of KITTI odometry."
        )
    transform = np.eye(4)
    transform[:3, 3] = -np.linalg.solve(K, aside)
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    return Intrinsics(None, (fx, fy), (cx, cy)), transform


def _is_upright(K: Float[np.ndarray, "3 3"]) -> bool:
    """Whether a matrix is that of intrinsics: upper triangular, with positive focal lengths."""
    return bool((np.tril(K, -1) == 0).all() and (np.diag(K) > 0).all() and K[2, 2] == 1)


def _laser(calibration: Path) -> Float[np.ndarray, "4 4"] | None:
    """The transform from the frame of the laser to that of camera 0, where the file has it."""
    lines = [line for line in read_lines(calibration) if line.startswith("Tr")]
    return _matrix(lines[0].partition(":")[2]) if lines else None


def _matrices(path: Path) -> list[Float[np.ndarray, "4 4"]]:
    """The 3×4 matrices of a file, a line each, with labels such as `P0:` or without."""
    lines = [line for line in read_lines(path) if line.strip() and not line.startswith("Tr")]
    matrices = [_matrix(line) for line in lines]
    found = [matrix for matrix in matrices if matrix is not None]
    if not found or len(found) < len(matrices):
        raise InputError(f"{quoted(path)} is no file of KITTI: each of its lines needs 12 numbers.")
    return found


def _matrix(line: str) -> Float[np.ndarray, "4 4"] | None:
    words = re.sub(r"^\s*P\d:", "", line).split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        return None
    if len(numbers) != 12 or not (np.abs(numbers) <= LARGEST).all():
        return None
    return np.vstack([numbers.reshape(3, 4), [0, 0, 0, 1]])


def _poses_of(folder: Path) -> Path | None:
    """The poses of the sequence in a folder; None where there are none."""
    sequence = folder.resolve()
    candidates = (folder / POSES, sequence.parent.parent / "poses" / f"{sequence.name}.txt")
    return next((path for path in candidates if os.path.isfile(path)), None)


def _sequence_of(poses: Path) -> Path:
    """The folder of the sequence that a file of poses belongs to."""
    folder = poses.resolve().parent.parent / "sequences" / poses.stem
    return folder if os.path.isdir(folder) else poses.parent


def _calibration_beside(folder: Path, poses: Path) -> Path:
    renamed = poses.with_name(poses.name.replace("poses", "calib"))
    for path in (folder / CALIBRATION, renamed):
        if os.path.isfile(path) and path != poses:
            return path
    raise InputError(
        f"{quoted(poses)} holds poses only, and there is no {CALIBRATION} in "
        f"{quoted(folder)}; copy it there from the same sequence."
    )


def _camera_folder(folder: Path) -> tuple[Path, int]:
    for name, camera in CAMERAS.items():
        if os.path.isdir(folder / name):
            return folder / name, camera
    raise InputError(
        f"There are no photographs in {quoted(folder)}; a folder image_2 or image_0 of the "
        "same sequence is needed."
    )


def _begins_with_a_pose(path: Path) -> bool:
    line, _, _ = read_head(path, MAX_LINE).partition(b"\n")
    first = _matrix(line.decode("utf-8-sig", errors="replace"))
    return first is not None and pose_defect(first) is None
