"""Segments of the Waymo Open Dataset, version 2: a parquet file per component and segment.

`camera_image/SEGMENT.parquet` holds the photographs, a row per camera and time, with the vehicle
pose; `camera_calibration` the cameras. If present, `lidar`, `lidar_calibration`, `lidar_pose` and
`vehicle_pose` give sparse depth, and `lidar_box` moving objects. Axes of vehicle and cameras are x
forward, y left, z up.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.driving.moving_objects import Box, build_upright_pose
from gscompleter.data.driving.parquet import ADVICE, read_columns
from gscompleter.data.driving.range_image import (
    build_poses,
    compute_inclinations,
    compute_points,
    transform_points,
)
from gscompleter.data.frame import Frame
from gscompleter.data.limits import MAX_SIDE
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.data.undistort import Distortion
from gscompleter.errors import InputError, quote_value

IMAGES = "camera_image"
CAMERAS = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
"""Camera names by their numbers in the tables."""
SIGN = 3
"""Box type of signs, which never move."""
CAMERA_FROM_OPENCV = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Axis change from x right, y down, z forward to x forward, y left, z up."""

Beams = tuple[Float[np.ndarray, "h"] | None, float, float]
"""Beam elevations of a laser in radians, ascending, and their lower and upper end."""

LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "k3", "p1", "p2")
TIME, CAMERA, LASER = "key.frame_timestamp_micros", "key.camera_name", "key.laser_name"


def has_waymo(path: Path) -> bool:
    """Check whether `path` is a folder of segments, or the photographs of one."""
    if os.path.isdir(path):
        return any((path / IMAGES).glob("*.parquet"))
    return path.suffix == ".parquet" and path.parent.name == IMAGES and os.path.isfile(path)


def open_waymo(path: Path) -> Iterator[Photographs]:
    """Open the segments in a folder, or the named one.

    Frames are numbered camera by camera, the front camera first, and by time.
    """
    if os.path.isdir(path):
        names = [file.stem for file in sorted((path / IMAGES).glob("*.parquet"))]
        segments = [Segment(path, name) for name in names]
    else:
        segments = [Segment(path.parent.parent, path.stem)]
    return map(_open_segment, segments)


@dataclass(frozen=True)
class Segment:
    """Twenty seconds of one drive."""

    root: Path
    """Folder with a subfolder per component."""
    name: str

    def get_path(self, component: str) -> Path:
        """Return the path of a component."""
        return self.root / component / f"{self.name}.parquet"

    def has_components(self, *components: str) -> bool:
        """Check whether all these components exist."""
        return all(os.path.isfile(self.get_path(component)) for component in components)

    def read_rows(
        self, component: str, columns: dict[str, str], **where: int
    ) -> Iterator[dict[str, Any]]:
        """Read rows of a component as dicts with the keys of `columns`, filtered by `where`."""
        keys = {{"time": TIME, "camera": CAMERA}[key]: value for key, value in where.items()}
        found = read_columns(self.get_path(component), list(columns.values()), keys)
        values = [found[column] for column in columns.values()]
        return (dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True))


def _open_segment(segment: Segment) -> Photographs:
    file = segment.get_path(IMAGES)
    columns = {"time": TIME, "camera": CAMERA, "pose": "[CameraImageComponent].pose.transform"}
    cameras = _read_cameras(segment)
    rows = sorted(
        (row for row in segment.read_rows(IMAGES, columns) if row["camera"] in CAMERAS),
        key=lambda row: (row["camera"], row["time"]),
    )
    if not rows:
        raise InputError(f"{quote_value(file)} holds no photographs; {ADVICE}.")
    frames = [_make_frame(segment, cameras, **row) for row in rows]
    return build_drive(segment.name, str(file), frames, front=CAMERAS[1])


def _make_frame(
    segment: Segment,
    cameras: dict[int, tuple[Intrinsics, Float[np.ndarray, "4 4"]]],
    time: int,
    camera: int,
    pose: Any,
) -> Frame:
    title = (
        f"the photograph of {CAMERAS[camera]} at {time} in {quote_value(segment.get_path(IMAGES))}"
    )
    if camera not in cameras:
        raise InputError(f"The camera of {title} has no calibration; {ADVICE}.")
    intrinsics, vehicle_from_camera = cameras[camera]
    measured = segment.has_components("lidar", "lidar_calibration", "vehicle_pose")
    boxed = segment.has_components("lidar_box", "vehicle_pose")
    return Frame(
        f"{CAMERAS[camera]}/{time}",
        title,
        _parse_matrix(pose, title) @ vehicle_from_camera @ CAMERA_FROM_OPENCV,
        intrinsics,
        partial(_read_image, segment, time, camera),
        sensor=CAMERAS[camera],
        laser_points=partial(_read_points, segment, time) if measured else None,
        boxes=partial(_read_boxes, segment, time) if boxed else None,
    )


def _read_cameras(segment: Segment) -> dict[int, tuple[Intrinsics, Float[np.ndarray, "4 4"]]]:
    """Read intrinsics and pose on the vehicle (Waymo axes) of each camera."""
    prefix = "[CameraCalibrationComponent]"
    columns = {"camera": CAMERA, **{key: f"{prefix}.intrinsic.{key}" for key in LENS}}
    columns |= {"width": f"{prefix}.width", "height": f"{prefix}.height"}
    columns |= {"pose": f"{prefix}.extrinsic.transform"}
    title = str(segment.get_path("camera_calibration"))
    return {
        row["camera"]: (_parse_intrinsics(row, title), _parse_matrix(row["pose"], title))
        for row in segment.read_rows("camera_calibration", columns)
    }


def _parse_intrinsics(row: dict[str, Any], title: str) -> Intrinsics:
    values = {key: value for key, value in row.items() if key != "pose"}
    if any(value is None or not np.isfinite(value) for value in values.values()):
        raise InputError(f"A camera in {title} lacks intrinsics; {ADVICE}.")
    size = (row["width"], row["height"])
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise InputError(f"A camera in {title} has images of {size} pixels; {ADVICE}.")
    return Intrinsics(
        size,
        (row["f_u"], row["f_v"]),
        (row["c_u"], row["c_v"]),
        distortion=Distortion(
            radial=(row["k1"], row["k2"], row["k3"]), tangential=(row["p1"], row["p2"])
        ),
    )


def _read_image(segment: Segment, time: int, camera: int) -> bytes:
    columns = {"image": "[CameraImageComponent].image"}
    found = [row["image"] for row in segment.read_rows(IMAGES, columns, time=time, camera=camera)]
    if len(found) != 1 or not isinstance(found[0], bytes):
        raise InputError(
            f"{quote_value(segment.get_path(IMAGES))} has no image of {CAMERAS[camera]} at "
            f"{time}; {ADVICE}."
        )
    return found[0]


@lru_cache(maxsize=2)
def _read_points(segment: Segment, time: int) -> Float[np.ndarray, "n 3"]:
    """Read the first laser returns in the world frame, in metres.

    The roof laser rotates while the vehicle drives; `lidar_pose` has the vehicle pose per pixel.
    """
    vehicle = _read_vehicle_pose(segment, time)
    prefix = "[LiDARComponent].range_image_return1"
    columns = {"laser": LASER, "values": f"{prefix}.values", "shape": f"{prefix}.shape"}
    lasers, turning = _read_lasers(segment), _read_pixel_poses(segment, time)
    points = [np.zeros((0, 3))]
    for row in segment.read_rows("lidar", columns, time=time):
        laser, image = row["laser"], _reshape_image(row, segment.get_path("lidar"))
        if image is None:
            continue
        ranges, poses = image[..., 0], turning.get(laser, vehicle)
        if laser not in lasers or not _is_consistent(ranges, lasers[laser][0], poses):
            raise InputError(
                f"Laser {laser} of {quote_value(segment.get_path('lidar'))} does not fit its "
                "calibration or "
                f"its poses; {ADVICE}."
            )
        points.append(_compute_hits(ranges, *lasers[laser], poses))
    return np.concatenate(points)


def _is_consistent(ranges: np.ndarray, beams: Beams, poses: np.ndarray) -> bool:
    """Check that the range image has one beam per row and one pose per pixel, if any."""
    values, low, high = beams
    known = low is not None and high is not None if values is None else len(values) == len(ranges)
    return known and (poses.ndim == 2 or poses.shape[:2] == ranges.shape)


def _compute_hits(
    ranges: Float[np.ndarray, "h w"],
    beams: Beams,
    extrinsic: Float[np.ndarray, "4 4"],
    vehicle: Float[np.ndarray, "h w 4 4"] | Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "n 3"]:
    """Compute hit points in the world frame; `vehicle` is one pose or one per pixel."""
    local = compute_points(ranges, compute_inclinations(*beams, len(ranges)), extrinsic)
    hit = np.isfinite(ranges) & (ranges > 0)
    return transform_points(local[hit], vehicle if vehicle.ndim == 2 else vehicle[hit])


def _read_vehicle_pose(segment: Segment, time: int) -> Float[np.ndarray, "4 4"]:
    title = str(segment.get_path("vehicle_pose"))
    columns = {"pose": "[VehiclePoseComponent].world_from_vehicle.transform"}
    found = [
        _parse_matrix(row["pose"], title)
        for row in segment.read_rows("vehicle_pose", columns, time=time)
    ]
    if len(found) != 1:
        raise InputError(f"{title} has {len(found)} poses at {time}; {ADVICE}.")
    return found[0]


def _read_lasers(segment: Segment) -> dict[int, tuple[Beams, Float[np.ndarray, "4 4"]]]:
    prefix = "[LiDARCalibrationComponent]"
    columns = {"laser": LASER, "pose": f"{prefix}.extrinsic.transform"}
    columns |= {key: f"{prefix}.beam_inclination.{key}" for key in ("values", "min", "max")}
    title = str(segment.get_path("lidar_calibration"))
    return {
        row["laser"]: ((row["values"], row["min"], row["max"]), _parse_matrix(row["pose"], title))
        for row in segment.read_rows("lidar_calibration", columns)
    }


def _read_pixel_poses(segment: Segment, time: int) -> dict[int, Float[np.ndarray, "h w 4 4"]]:
    """Read vehicle poses per pixel of each range image, if present."""
    if not segment.has_components("lidar_pose"):
        return {}
    prefix = "[LiDARPoseComponent].range_image_return1"
    columns = {"laser": LASER, "values": f"{prefix}.values", "shape": f"{prefix}.shape"}
    images = {
        row["laser"]: _reshape_image(row, segment.get_path("lidar_pose"))
        for row in segment.read_rows("lidar_pose", columns, time=time)
    }
    return {laser: build_poses(image) for laser, image in images.items() if image is not None}


def _reshape_image(row: dict[str, Any], file: Path) -> Float[np.ndarray, "h w c"] | None:
    values, shape = row["values"], row["shape"]
    if values is None or shape is None:
        return None
    if len(shape) != 3 or any(side < 1 for side in shape) or len(values) != np.prod(shape):
        raise InputError(f"A range image in {quote_value(file)} is damaged; {ADVICE}.")
    return np.asarray(values, dtype=np.float64).reshape(shape)


def _read_boxes(segment: Segment, time: int) -> tuple[Box, ...]:
    """Read the boxes of objects around the vehicle, except signs."""
    vehicle = _read_vehicle_pose(segment, time)
    prefix = "[LiDARBoxComponent]"
    columns = {"type": f"{prefix}.type", "heading": f"{prefix}.box.heading"}
    columns |= {f"center_{axis}": f"{prefix}.box.center.{axis}" for axis in "xyz"}
    columns |= {f"size_{axis}": f"{prefix}.box.size.{axis}" for axis in "xyz"}
    columns |= {f"speed_{axis}": f"{prefix}.speed.{axis}" for axis in "xyz"}
    rows = segment.read_rows("lidar_box", columns, time=time)
    return tuple(_parse_box(row, vehicle) for row in rows if row["type"] != SIGN)


def _parse_box(row: dict[str, Any], vehicle: Float[np.ndarray, "4 4"]) -> Box:
    def read(key: str) -> Float[np.ndarray, "3"]:
        return np.array([row[f"{key}_{axis}"] for axis in "xyz"], dtype=np.float64)

    speed, (length, width, height) = float(np.linalg.norm(read("speed"))), read("size").tolist()
    pose = vehicle @ build_upright_pose(read("center"), np.float64(row["heading"]))
    return Box(pose, (length, width, height), speed if np.isfinite(speed) else None)


def _parse_matrix(values: Any, title: str) -> Float[np.ndarray, "4 4"]:
    if values is None or len(values) != 16 or not np.isfinite(values).all():
        raise InputError(f"A transform in {title} is damaged; {ADVICE}.")
    return np.asarray(values, dtype=np.float64).reshape(4, 4)
