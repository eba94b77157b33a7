"""KITTI: odometry sequences, and raw drives (synced and rectified).

A sequence has a file of poses, the upper 3×4 of camera-to-world of camera 0 in OpenCV axes, one
line per frame, and a `calib.txt`, whose lines are the 3×4 projections from the frame of camera 0 to
the rectified cameras, and optionally `Tr`, the laser pose. The sweeps in `velodyne` give depth.

A drive `DATE/DATE_drive_NNNN_sync` holds `image_02/data`, `oxts/data` with poses from GPS and
inertial sensors, and optionally `velodyne_points/data`; `DATE` holds the calibrations. Latitude and
longitude become metres by a Mercator projection at the scale of the first latitude, as in the
development kit.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, find_pose_defect
from gscompleter.data.driving.lidar import build_poses, read_sweep
from gscompleter.data.frame import Frame
from gscompleter.data.photographs import Photographs, build_drive, build_photographs
from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import MAX_LINE, read_head, read_lines

POSES, CALIBRATION = "poses.txt", "calib.txt"
CAMERAS = {"image_2": 2, "image_0": 0, "image_3": 3, "image_1": 1, "image_l": 0, "image_r": 1}
"""Folders of photographs of a sequence in search order, and their camera numbers."""
RAW_CAMERAS = ("02", "03", "00", "01")
"""Cameras of a drive in order of preference: colour left, colour right, then grey."""
MAX_ENTRY = 1e12
EARTH_RADIUS = 6_378_137.0
"""Earth radius in metres."""
MAX_LATITUDE = 89.0
"""Largest latitude in degrees; Mercator's map has no poles."""


def has_kitti(path: Path) -> bool:
    """Check whether `path` is a KITTI odometry sequence, or a file of poses."""
    if os.path.isdir(path):
        return os.path.isfile(path / CALIBRATION) and _find_poses(path) is not None
    if path.suffix != ".txt" or not os.path.isfile(path):
        return False
    line, _, _ = read_head(path, MAX_LINE).partition(b"\n")
    first = _parse_matrix(line.decode("utf-8-sig", errors="replace"))
    return first is not None and find_pose_defect(first) is None


def open_kitti(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a sequence, numbered like the poses; its folder names it.

    `path` is a folder with calib.txt and poses.txt, or with its poses in ../../poses; or a file of
    poses, with calibration and photographs beside it or in ../sequences. The left colour camera (2)
    is preferred.
    """
    poses, folder = (_find_poses(path), path) if os.path.isdir(path) else (path, path.parent)
    if poses is None:
        raise InputError(f"There are no poses in {quote_value(path)}; put {POSES} into it.")
    sequence = poses.resolve().parent.parent / "sequences" / poses.stem
    if poses == path and os.path.isdir(sequence):
        folder = sequence
    calibration = _find_calibration(folder, poses)
    images, camera = _find_camera_folder(folder)
    projections = _read_matrices(calibration)
    if len(projections) <= camera:
        raise InputError(
            f"{quote_value(calibration)} has {len(projections)} projections, and the photographs "
            f"are those of camera {camera}; a line P{camera} is needed."
        )
    title = str(calibration)
    intrinsics, first_from_camera = _split_projection(projections[camera], camera, title)
    laser = next((line for line in read_lines(calibration) if line.startswith("Tr")), "")
    first_from_laser = _parse_matrix(laser.partition(":")[2])
    frames = []
    for number, first in enumerate(_read_matrices(poses)):
        name, title = f"{number:06d}", f"frame {number} of {quote_value(poses)}"
        c2w, sweep = first @ first_from_camera, folder / "velodyne" / f"{name}.bin"
        lasers = None if first_from_laser is None else _find_sweep(sweep, first @ first_from_laser)
        frames.append(Frame(name, title, c2w, intrinsics, images / name, laser_points=lasers))
    yield build_photographs(folder.resolve().name, str(poses), frames)


def has_kitti_raw(path: Path) -> bool:
    """Check whether `path` is the folder of a drive."""
    return os.path.isdir(path / "oxts" / "data") and _find_raw_camera(path) is not None


def open_kitti_raw(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a drive in the order of their numbers; its folder names it."""
    camera = _find_raw_camera(path)
    if camera is None:
        raise InputError(
            f"There are no photographs in {quote_value(path)}; a folder image_02 is needed."
        )
    date = path.resolve().parent
    imu_from_laser = np.linalg.pinv(_read_rigid(date / "calib_imu_to_velo.txt"))
    intrinsics, first_from_camera, first_from_laser = _read_raw_camera(date, camera)
    laser_from_first = np.linalg.pinv(first_from_laser)
    images = sorted((path / f"image_{camera}" / "data").iterdir())
    readings = [_read_oxts(path / "oxts" / "data" / f"{image.stem}.txt") for image in images]
    scale = float(np.cos(np.radians(readings[0][0])))
    frames = []
    for image, reading in zip(images, readings, strict=True):
        laser = _compute_imu_pose(reading, scale) @ imu_from_laser
        c2w = laser @ laser_from_first @ first_from_camera
        title = f"photograph {image.stem} of {quote_value(path)}"
        lasers = _find_sweep(path / "velodyne_points" / "data" / f"{image.stem}.bin", laser)
        frames.append(Frame(image.stem, title, c2w, intrinsics, image, laser_points=lasers))
    yield build_drive(path.resolve().name, str(path), frames)


def _find_sweep(
    path: Path, world_from_laser: Float[np.ndarray, "4 4"]
) -> Callable[[], Float[np.ndarray, "n 3"]] | None:
    """Return a reader of the points of a sweep; None if there is no file."""
    return partial(read_sweep, path, world_from_laser) if os.path.isfile(path) else None


def _read_raw_camera(
    date: Path, camera: str
) -> tuple[Intrinsics, Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """Read the intrinsics of a camera, and the transforms from it and the laser to camera 0."""
    path = date / "calib_cam_to_cam.txt"
    entries, first_from_laser = _read_entries(path), _read_rigid(date / "calib_velo_to_cam.txt")
    rectify, projection = np.eye(4), np.eye(4)
    rectify[:3, :3] = _get_entry(entries, "R_rect_00", 9, path).reshape(3, 3)
    projection[:3] = _get_entry(entries, f"P_rect_{camera}", 12, path).reshape(3, 4)
    return *_split_projection(projection, int(camera), str(path)), rectify @ first_from_laser


def _split_projection(
    projection: Float[np.ndarray, "4 4"], camera: int, title: str
) -> tuple[Intrinsics, Float[np.ndarray, "4 4"]]:
    """Split the projection of a rectified camera into intrinsics and the transform to camera 0."""
    K, aside = projection[:3, :3], projection[:3, 3]
    if (np.tril(K, -1) != 0).any() or (np.diag(K) <= 0).any() or K[2, 2] != 1:
        raise InputError(
            f"The projection of camera {camera} in {title} is not that of a rectified "
            "camera; name the calib.txt of KITTI odometry."
        )
    transform = np.eye(4)
    transform[:3, 3] = -np.linalg.solve(K, aside)
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    return Intrinsics(None, (fx, fy), (cx, cy)), transform


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
    numbers = _parse_numbers(re.sub(r"^\s*P\d:", "", line))
    if numbers is None or len(numbers) != 12:
        return None
    return np.vstack([numbers.reshape(3, 4), [0, 0, 0, 1]])


def _parse_numbers(text: str) -> Float[np.ndarray, "n"] | None:
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    return numbers if (np.abs(numbers) <= MAX_ENTRY).all() else None


def _compute_imu_pose(reading: Float[np.ndarray, "6"], scale: float) -> Float[np.ndarray, "4 4"]:
    """Compute the pose of the inertial sensor in map axes (east, north, up), in metres."""
    latitude, longitude, altitude, roll, pitch, yaw = reading.tolist()
    east = scale * EARTH_RADIUS * np.radians(longitude)
    north = scale * EARTH_RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    return build_poses(np.array([roll, pitch, yaw, east, north, altitude]))


def _read_oxts(path: Path) -> Float[np.ndarray, "6"]:
    """Read latitude, longitude (degrees), altitude (metres), roll, pitch and yaw (radians)."""
    lines = [line for line in read_lines(path) if line.strip()]
    numbers = _parse_numbers(" ".join(lines[0].split()[:6])) if lines else None
    if numbers is None or len(numbers) != 6 or not abs(numbers[0]) <= MAX_LATITUDE:
        raise InputError(
            f"{quote_value(path)} holds no latitude, longitude and angles; copy it again."
        )
    return numbers


def _read_rigid(path: Path) -> Float[np.ndarray, "4 4"]:
    """Read a rigid transform from the lines R and T."""
    entries, transform = _read_entries(path), np.eye(4)
    transform[:3, :3] = _get_entry(entries, "R", 9, path).reshape(3, 3)
    transform[:3, 3] = _get_entry(entries, "T", 3, path)
    return transform


def _get_entry(
    entries: Mapping[str, Float[np.ndarray, "_"]], key: str, count: int, path: Path
) -> Float[np.ndarray, "n"]:
    found = entries.get(key)
    if found is None or len(found) != count:
        raise InputError(
            f"{path} has no line {key} of {count} numbers; copy it from the same date."
        )
    return found


def _read_entries(path: Path) -> dict[str, Float[np.ndarray, "_"]]:
    """Read the numbers of a calibration by their labels."""
    parts = (line.partition(":") for line in read_lines(path))
    found = {label.strip(): _parse_numbers(rest) for label, colon, rest in parts if colon}
    return {label: numbers for label, numbers in found.items() if numbers is not None}


def _find_poses(folder: Path) -> Path | None:
    sequence = folder.resolve()
    candidates = (folder / POSES, sequence.parent.parent / "poses" / f"{sequence.name}.txt")
    return next((path for path in candidates if os.path.isfile(path)), None)


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


def _find_raw_camera(path: Path) -> str | None:
    folders = {camera: path / f"image_{camera}" / "data" for camera in RAW_CAMERAS}
    return next((c for c, folder in folders.items() if any(folder.glob("*.*"))), None)
