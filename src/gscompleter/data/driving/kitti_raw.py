"""Drives of raw KITTI (synced and rectified), with poses from GPS and inertial sensors.

`DATE/DATE_drive_NNNN_sync` holds `image_02/data`, `oxts/data` and optionally
`velodyne_points/data`; `DATE` holds the calibrations. Latitude and longitude become metres by a
Mercator projection at the scale of the first latitude, as in the development kit.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.driving.kitti import MAX_ENTRY, split_projection
from gscompleter.data.driving.range_image import build_poses
from gscompleter.data.driving.velodyne import read_sweep
from gscompleter.data.frame import Frame
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import read_lines

EARTH_RADIUS = 6_378_137.0
"""Earth radius in metres."""
CAMERAS = ("02", "03", "00", "01")
"""Cameras in order of preference: colour left, colour right, then grey."""
MAX_LATITUDE = 89.0
"""Largest latitude in degrees; Mercator's map has no poles."""


def has_kitti_raw(path: Path) -> bool:
    """Check whether `path` is the folder of a drive."""
    return os.path.isdir(path / "oxts" / "data") and _find_camera(path) is not None


def open_kitti_raw(path: Path) -> Iterator[Photographs]:
    """Open the photographs of a drive in the order of their numbers; its folder names it."""
    camera = _find_camera(path)
    if camera is None:
        raise InputError(
            f"There are no photographs in {quote_value(path)}; a folder image_02 is needed."
        )
    rig = _read_rig(path.resolve().parent, camera)
    images = sorted((path / f"image_{camera}" / "data").iterdir())
    readings = [_read_oxts(path / "oxts" / "data" / f"{image.stem}.txt") for image in images]
    scale = float(np.cos(np.radians(readings[0][0])))
    frames = [
        _make_frame(path, image, rig, _compute_pose(reading, scale))
        for image, reading in zip(images, readings, strict=True)
    ]
    yield build_drive(path.resolve().name, str(path), frames)


@dataclass(frozen=True, eq=False)
class _Rig:
    """Calibration of the sensors on the vehicle."""

    camera: str
    projection: Float[np.ndarray, "4 4"]
    title: str
    imu_from_laser: Float[np.ndarray, "4 4"]
    laser_from_rectified: Float[np.ndarray, "4 4"]


def _read_rig(date: Path, camera: str) -> _Rig:
    title = str(date / "calib_cam_to_cam.txt")
    cameras = _read_calibration(date / "calib_cam_to_cam.txt")
    cam_from_laser = _read_rigid(date / "calib_velo_to_cam.txt")
    laser_from_imu = _read_rigid(date / "calib_imu_to_velo.txt")
    rectify = np.eye(4)
    rectify[:3, :3] = _get_entry(cameras, "R_rect_00", 9, title).reshape(3, 3)
    projection = np.eye(4)
    projection[:3] = _get_entry(cameras, f"P_rect_{camera}", 12, title).reshape(3, 4)
    laser_from_rectified = np.linalg.pinv(rectify @ cam_from_laser)
    return _Rig(camera, projection, title, np.linalg.pinv(laser_from_imu), laser_from_rectified)


def _make_frame(path: Path, image: Path, rig: _Rig, imu: Float[np.ndarray, "4 4"]) -> Frame:
    intrinsics, first_from_camera = split_projection(rig.projection, int(rig.camera), rig.title)
    laser = imu @ rig.imu_from_laser
    sweep = path / "velodyne_points" / "data" / f"{image.stem}.bin"
    return Frame(
        image.stem,
        f"photograph {image.stem} of {quote_value(path)}",
        laser @ rig.laser_from_rectified @ first_from_camera,
        intrinsics,
        image,
        laser_points=partial(read_sweep, sweep, laser) if os.path.isfile(sweep) else None,
    )


def _compute_pose(reading: Float[np.ndarray, "6"], scale: float) -> Float[np.ndarray, "4 4"]:
    """Compute the pose of the inertial sensor in map axes (east, north, up), in metres."""
    latitude, longitude, altitude, roll, pitch, yaw = reading.tolist()
    east = scale * EARTH_RADIUS * np.radians(longitude)
    north = scale * EARTH_RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    return build_poses(np.array([roll, pitch, yaw, east, north, altitude]))


def _read_oxts(path: Path) -> Float[np.ndarray, "6"]:
    """Read latitude, longitude (degrees), altitude (metres), roll, pitch and yaw (radians)."""
    words = _read_nonempty_lines(path)[0].split() if _read_nonempty_lines(path) else []
    numbers = _parse_numbers(" ".join(words[:6]))
    if numbers is None or len(numbers) != 6 or abs(numbers[0]) > MAX_LATITUDE:
        raise InputError(
            f"{quote_value(path)} holds no latitude, longitude and angles; copy it again."
        )
    return numbers


def _read_rigid(path: Path) -> Float[np.ndarray, "4 4"]:
    """Read a rigid transform from the lines R and T."""
    entries = _read_calibration(path)
    transform = np.eye(4)
    transform[:3, :3] = _get_entry(entries, "R", 9, str(path)).reshape(3, 3)
    transform[:3, 3] = _get_entry(entries, "T", 3, str(path))
    return transform


def _get_entry(
    entries: Mapping[str, Float[np.ndarray, "_"]], key: str, count: int, title: str
) -> Float[np.ndarray, "n"]:
    found = entries.get(key)
    if found is None or len(found) != count:
        raise InputError(
            f"{title} has no line {key} of {count} numbers; copy it from the same date."
        )
    return found


def _read_calibration(path: Path) -> dict[str, Float[np.ndarray, "_"]]:
    parts = (line.partition(":") for line in _read_nonempty_lines(path))
    found = {label.strip(): _parse_numbers(rest) for label, colon, rest in parts if colon}
    return {label: numbers for label, numbers in found.items() if numbers is not None}


def _read_nonempty_lines(path: Path) -> list[str]:
    return [line for line in read_lines(path) if line.strip()]


def _parse_numbers(text: str) -> Float[np.ndarray, "n"] | None:
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    return numbers if (np.abs(numbers) <= MAX_ENTRY).all() else None


def _find_camera(path: Path) -> str | None:
    folders = {camera: path / f"image_{camera}" / "data" for camera in CAMERAS}
    return next((c for c, folder in folders.items() if any(folder.glob("*.*"))), None)
