"""KITTI odometry sequences: a file of poses and one of camera projections.

A pose is the upper 3×4 of camera-to-world of camera 0 in OpenCV axes, one line per frame. A
calibration line is the 3×4 projection from the frame of camera 0 to a rectified camera. If it has
`Tr`, the laser pose, the sweeps in `velodyne` give sparse depth.
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

from gscompleter.data.cameras import Intrinsics, find_pose_defect
from gscompleter.data.driving.velodyne import read_sweep
from gscompleter.data.frame import Frame
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import MAX_LINE, read_head, read_lines

POSES, CALIBRATION = "poses.txt", "calib.txt"
CAMERAS = {"image_2": 2, "image_0": 0, "image_3": 3, "image_1": 1, "image_l": 0, "image_r": 1}
"""Folders of photographs in search order, and their camera numbers."""
MAX_ENTRY = 1e12


def has_kitti(path: Path) -> bool:
    """Check whether `path` is a KITTI odometry sequence, or a file of poses."""
    if os.path.isdir(path):
        return os.path.isfile(path / CALIBRATION) and _find_poses(path) is not None
    return path.suffix == ".txt" and os.path.isfile(path) and _is_pose_file(path)


def open_kitti(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a sequence, numbered like the poses; its folder names it.

    `path` is a folder with calib.txt and poses.txt, or with its poses in ../../poses; or a file of
    poses, with calibration and photographs beside it or in ../sequences. The left colour camera (2)
    is preferred.
    """
    poses = _find_poses(path) if os.path.isdir(path) else path
    if poses is None:
        raise InputError(f"There are no poses in {quote_value(path)}; put {POSES} into it.")
    folder = path if os.path.isdir(path) else _find_sequence(path)
    calibration = _find_calibration(folder, poses)
    images, camera = _find_camera_folder(folder)
    intrinsics, first_from_camera = _read_camera(calibration, camera)
    first_from_laser = _read_laser(calibration)
    frames = []
    for number, first in enumerate(_read_matrices(poses)):
        frame = _make_frame(number, first @ first_from_camera, intrinsics, images, poses)
        sweep = folder / "velodyne" / f"{number:06d}.bin"
        if first_from_laser is not None and os.path.isfile(sweep):
            measured = partial(read_sweep, sweep, first @ first_from_laser)
            frame = replace(frame, laser_points=measured)
        frames.append(frame)
    yield build_photographs(folder.resolve().name, str(poses), frames)


def _make_frame(
    number: int, c2w: Float[np.ndarray, "4 4"], intrinsics: Intrinsics, images: Path, poses: Path
) -> Frame:
    name = f"{number:06d}"
    title = f"frame {number} of {quote_value(poses)}"
    return Frame(name, title, c2w, intrinsics, images / name)


def _read_camera(calibration: Path, camera: int) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    """Read the intrinsics of a camera and the transform from its frame to camera 0."""
    projections = _read_matrices(calibration)
    if len(projections) <= camera:
        raise InputError(
            f"{quote_value(calibration)} has {len(projections)} projections, and the photographs "
            "are "
            f"those of camera {camera}; a line P{camera} is needed."
        )
    return split_projection(projections[camera], camera, str(calibration))


def split_projection(
    projection: Float[np.ndarray, "4 4"], camera: int, title: str
) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    """Split the projection of a rectified camera into intrinsics and the transform to camera 0."""
    K, aside = projection[:3, :3], projection[:3, 3]
    if not _is_intrinsic_matrix(K):
        raise InputError(
            f"The projection of camera {camera} in {title} is not that of a rectified "
            "camera; name the calib.txt of KITTI odometry."
        )
    transform = np.eye(4)
    transform[:3, 3] = -np.linalg.solve(K, aside)
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    return Intrinsics(None, (fx, fy), (cx, cy)), transform


def _is_intrinsic_matrix(K: Float[np.ndarray, "3 3"]) -> bool:
    return bool((np.tril(K, -1) == 0).all() and (np.diag(K) > 0).all() and K[2, 2] == 1)


def _read_laser(calibration: Path) -> Float[np.ndarray, "4 4"] | None:
    """Read the transform from the laser frame to camera 0, if the file has it."""
    lines = [line for line in read_lines(calibration) if line.startswith("Tr")]
    return _parse_matrix(lines[0].partition(":")[2]) if lines else None


def _read_matrices(path: Path) -> list[Float[np.ndarray, "4 4"]]:
    """Read the 3×4 matrices of a file, one per line, with or without labels such as `P0:`."""
    lines = [line for line in read_lines(path) if line.strip() and not line.startswith("Tr")]
    matrices = [_parse_matrix(line) for line in lines]
    found = [matrix for matrix in matrices if matrix is not None]
    if not found or len(found) < len(matrices):
        raise InputError(
            f"{quote_value(path)} is no file of KITTI: each of its lines needs 12 numbers."
        )
    return found


def _parse_matrix(line: str) -> Float[np.ndarray, "4 4"] | None:
    words = re.sub(r"^\s*P\d:", "", line).split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        return None
    if len(numbers) != 12 or not (np.abs(numbers) <= MAX_ENTRY).all():
        return None
    return np.vstack([numbers.reshape(3, 4), [0, 0, 0, 1]])


def _find_poses(folder: Path) -> Path | None:
    sequence = folder.resolve()
    candidates = (folder / POSES, sequence.parent.parent / "poses" / f"{sequence.name}.txt")
    return next((path for path in candidates if os.path.isfile(path)), None)


def _find_sequence(poses: Path) -> Path:
    folder = poses.resolve().parent.parent / "sequences" / poses.stem
    return folder if os.path.isdir(folder) else poses.parent


def _find_calibration(folder: Path, poses: Path) -> Path:
    renamed = poses.with_name(poses.name.replace("poses", "calib"))
    for path in (folder / CALIBRATION, renamed):
        if os.path.isfile(path) and path != poses:
            return path
    raise InputError(
        f"{quote_value(poses)} holds poses only, and there is no {CALIBRATION} in "
        f"{quote_value(folder)}; copy it there from the same sequence."
    )


def _find_camera_folder(folder: Path) -> tuple[Path, int]:
    for name, camera in CAMERAS.items():
        if os.path.isdir(folder / name):
            return folder / name, camera
    raise InputError(
        f"There are no photographs in {quote_value(folder)}; a folder image_2 or image_0 of the "
        "same sequence is needed."
    )


def _is_pose_file(path: Path) -> bool:
    line, _, _ = read_head(path, MAX_LINE).partition(b"\n")
    first = _parse_matrix(line.decode("utf-8-sig", errors="replace"))
    return first is not None and find_pose_defect(first) is None
