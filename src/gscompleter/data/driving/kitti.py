"""KITTI: odometry sequences, and raw drives (synced and rectified).

Poses of a sequence are the upper 3×4 of camera-to-world of camera 0 in OpenCV axes, one line per
frame. Lines of `calib.txt` are the 3×4 projections from the frame of camera 0 to the rectified
cameras, and optionally `Tr`, the laser pose.

A drive has poses from GPS and inertial sensors, and the folder above it the calibrations. Latitude
and longitude become metres by a Mercator projection at the scale of the first latitude.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, find_pose_defect
from gscompleter.data.driving.vehicle import build_poses, read_sweep
from gscompleter.data.file_names import is_photograph_name
from gscompleter.data.frame import Frame
from gscompleter.data.limits import MAX_NUMBER, require
from gscompleter.data.photographs import Photographs, build_drive, build_photographs
from gscompleter.system.errors import quote_value
from gscompleter.system.files.reading import MAX_LINE, list_entries, read_head, read_lines

KITTI_POSES_FILE = "poses.txt"
CALIBRATION = "calib.txt"
CAMERA_NUMBERS = {
    "image_2": 2,
    "image_0": 0,
    "image_3": 3,
    "image_1": 1,
    "image_l": 0,
    "image_r": 1,
}
"""Folders of photographs of a sequence in search order, and their camera numbers."""
RAW_CAMERAS = ("02", "03", "00", "01")
"""Cameras of a drive in order of preference: colour left, colour right, then grey."""
EARTH_RADIUS = 6_378_137.0  # metres
MAX_LATITUDE = 89.0
"""Largest latitude in degrees; Mercator's map has no poles."""

LineNumbers = Float[np.ndarray, "_"]
HomogeneousMatrix = Float[np.ndarray, "4 4"]


def has_kitti(path: Path) -> bool:
    """Check whether `path` is a KITTI odometry sequence, or a file of poses."""
    if os.path.isdir(path):
        return os.path.isfile(path / CALIBRATION) and bool(_list_poses(path))
    # A file of poses is only known by its first line: twelve numbers that are a rigid transform.
    line, _, _ = read_head(path, MAX_LINE).partition(b"\n")
    first = _parse_numbers(line.decode("utf-8-sig", errors="replace"))
    is_pose = len(first) == 12 and find_pose_defect(_complete(first)) is None
    return is_pose and path.suffix == ".txt"


def open_kitti(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a sequence, numbered like the poses; its folder names it.

    `path` is a folder with calib.txt and poses.txt, or with its poses in ../../poses; or a file of
    poses, with calibration and photographs beside it or in ../sequences.
    """
    poses = _list_poses(path)[0]
    folder = path if os.path.isdir(path) else path.parent
    sequence = poses.parent.resolve().parent / "sequences" / poses.stem
    if poses == path and os.path.isdir(sequence):
        folder = sequence
    calibration = folder / CALIBRATION

    # calib.txt labels the projections P0 to P3; some copies omit the labels, one camera a line.
    entries = _read_entries(calibration)
    images = next((name for name in CAMERA_NUMBERS if os.path.isdir(folder / name)), "image_2")
    camera = CAMERA_NUMBERS[images]
    label = f"P{camera}" if f"P{camera}" in entries else str(camera)
    projection = _get_matrix(entries, label, calibration)
    intrinsics, first_from_camera = _split_projection(projection, calibration)
    lasers = [_get_matrix(entries, label, calibration) for label in entries if label[:2] == "Tr"]

    frames = []
    rows = _read_entries(poses)
    require(rows, f"{quote_value(poses)} holds no poses; copy it again.")
    for number, row in enumerate(rows):
        name = f"{number:06d}"
        title = f"frame {number} of {quote_value(poses)}"
        # All poses are those of camera 0; laser and photograph have a fixed place beside it.
        first = _get_matrix(rows, row, poses)
        sweep = folder / "velodyne" / f"{name}.bin"
        points = _find_sweep(sweep, first @ lasers[0]) if lasers else None
        c2w = first @ first_from_camera
        image = folder / images / name
        frames.append(Frame(name, title, c2w, intrinsics, image, laser_points=points))
    yield build_photographs(folder.resolve().name, quote_value(poses), frames)


def has_kitti_raw(path: Path) -> bool:
    """Check whether `path` is the folder of a drive."""
    return os.path.isdir(path / "oxts" / "data") and bool(_list_raw_cameras(path))


def open_kitti_raw(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a drive in the order of their numbers; its folder names it."""
    camera = _list_raw_cameras(path)[0]
    date = path.resolve().parent
    # The chain of frames: map <- inertial sensor <- laser <- camera 0 <- camera of the photographs.
    # Calibration files hold the transforms in the other direction. `pinv` also takes what is not
    # rigid, which is refused with the poses.
    imu_from_laser = np.linalg.pinv(_read_rigid(date / "calib_imu_to_velo.txt"))
    intrinsics, first_from_camera, first_from_laser = _read_raw_camera(date, camera)
    laser_from_first = np.linalg.pinv(first_from_laser)

    images = _list_raw_photographs(path, camera)
    readings = [_read_oxts(path / "oxts" / "data" / f"{image.stem}.txt") for image in images]
    # One scale of the map for all frames, that at the first latitude, so that it stays rigid.
    scale = float(np.cos(np.radians(readings[0][0])))
    frames = []
    for image, reading in zip(images, readings, strict=True):
        laser = _compute_imu_pose(reading, scale) @ imu_from_laser
        title = f"photograph {quote_value(image.stem)} of {quote_value(path)}"
        lasers = _find_sweep(path / "velodyne_points" / "data" / f"{image.stem}.bin", laser)
        c2w = laser @ laser_from_first @ first_from_camera
        frames.append(Frame(image.stem, title, c2w, intrinsics, image, laser_points=lasers))
    yield build_drive(path.resolve().name, quote_value(path), frames)


def _find_sweep(
    path: Path, world_from_laser: HomogeneousMatrix
) -> partial[Float[np.ndarray, "n 3"]] | None:
    return partial(read_sweep, path, world_from_laser) if os.path.isfile(path) else None


def _read_raw_camera(
    date: Path, camera: str
) -> tuple[Intrinsics, HomogeneousMatrix, HomogeneousMatrix]:
    """Read the intrinsics of a camera, and the transforms from it and the laser to camera 0."""
    path = date / "calib_cam_to_cam.txt"
    entries = _read_entries(path)
    # Photographs are rectified, and the laser's calibration is with the camera before that.
    rectify = np.eye(4)
    rectify[:3, :3] = _get_entry(entries, "R_rect_00", 9, path).reshape(3, 3)
    projection = _get_matrix(entries, f"P_rect_{camera}", path)
    first_from_laser = rectify @ _read_rigid(date / "calib_velo_to_cam.txt")
    # The size that the projection belongs to: copies of a drive may have smaller photographs.
    label = f"S_rect_{camera}"
    size = None
    if label in entries:
        width, height = _get_entry(entries, label, 2, path).round().astype(int).tolist()
        require(
            min(width, height) > 0,
            f"{quote_value(path)} has a size without pixels in line {label}; copy it again.",
        )
        size = width, height
    return *_split_projection(projection, path, size), first_from_laser


def _split_projection(
    projection: HomogeneousMatrix, path: Path, size: tuple[int, int] | None = None
) -> tuple[Intrinsics, HomogeneousMatrix]:
    """Split the projection of a rectified camera into intrinsics and the transform to camera 0.

    `size` is the width and height of its images; None for those of the photographs.
    """
    K = projection[:3, :3]
    # Rectified cameras are all turned alike, so the left part is K alone, which has no skew.
    require(
        not np.tril(K, -1).any() and K[0, 1] == 0 and (np.diag(K) > 0).all() and K[2, 2] == 1,
        f"The projection in {quote_value(path)} is not that of a rectified camera; name the "
        "calib.txt of KITTI odometry.",
    )
    # P = K [I | t], where t leads from camera 0 to this camera.
    transform = np.eye(4)
    transform[:3, 3] = -np.linalg.solve(K, projection[:3, 3])
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    return Intrinsics(size, (fx, fy), (cx, cy)), transform


def _compute_imu_pose(reading: LineNumbers, scale: float) -> HomogeneousMatrix:
    """Compute the pose of the inertial sensor in map axes (east, north, up), in metres."""
    latitude, longitude, altitude, roll, pitch, yaw = reading.tolist()
    # Mercator's projection, as in KITTI's development kit (`convertOxtsToPose`).
    east = scale * EARTH_RADIUS * np.radians(longitude)
    north = scale * EARTH_RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    return build_poses(np.array([roll, pitch, yaw, east, north, altitude]))


def _read_oxts(path: Path) -> LineNumbers:
    """Read latitude, longitude (degrees), altitude (metres), roll, pitch and yaw (radians)."""
    numbers = _read_entries(path).get("0", np.zeros(0))[:6]
    fits = len(numbers) == 6 and abs(numbers[0]) <= MAX_LATITUDE
    require(fits, f"{quote_value(path)} holds no latitude, longitude and angles; copy it again.")
    return numbers


def _read_rigid(path: Path) -> HomogeneousMatrix:
    """Read a rigid transform from the lines R and T."""
    entries = _read_entries(path)
    rotation = _get_entry(entries, "R", 9, path).reshape(3, 3)
    translation = _get_entry(entries, "T", 3, path)
    return _complete(np.column_stack([rotation, translation]))


def _read_entries(path: Path) -> dict[str, LineNumbers]:
    """Read the numbers of each line by its label, or by the number of the line without one."""
    entries = {}
    for number, line in enumerate(line for line in read_lines(path) if line.strip()):
        label, colon, rest = line.partition(":")
        if colon:
            entries[label.strip()] = _parse_numbers(rest)
        else:
            entries[str(number)] = _parse_numbers(line)
    return entries


def _get_entry(
    entries: Mapping[str, LineNumbers], label: str, count: int, path: Path
) -> LineNumbers:
    numbers = entries.get(label, np.zeros(0))
    require(
        len(numbers) == count,
        f"{quote_value(path)} has no line {label} of {count} numbers; copy it again.",
    )
    return numbers


def _get_matrix(entries: Mapping[str, LineNumbers], label: str, path: Path) -> HomogeneousMatrix:
    return _complete(_get_entry(entries, label, 12, path))


def _complete(numbers: LineNumbers | Float[np.ndarray, "3 4"]) -> HomogeneousMatrix:
    """Complete the upper 3×4 of a matrix."""
    return np.vstack([numbers.reshape(3, 4), [0, 0, 0, 1]])


def _parse_numbers(text: str) -> LineNumbers:
    """Parse the numbers of a line; none if a word is no number."""
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        return np.zeros(0)
    return numbers if (np.abs(numbers) <= MAX_NUMBER).all() else np.zeros(0)


def _list_poses(path: Path) -> list[Path]:
    """List the files of poses of a sequence, which may be one itself."""
    if not os.path.isdir(path):
        return [path]
    sequence = path.resolve()
    candidates = (
        path / KITTI_POSES_FILE,
        sequence.parent.parent / "poses" / f"{sequence.name}.txt",
    )
    return [file for file in candidates if os.path.isfile(file)]


def _list_raw_cameras(path: Path) -> list[str]:
    return [camera for camera in RAW_CAMERAS if _list_raw_photographs(path, camera)]


def _list_raw_photographs(path: Path, camera: str) -> list[Path]:
    files = list_entries(path / f"image_{camera}" / "data")
    return [file for file in files if is_photograph_name(file.name)]
