"""A small segment of the Waymo Open Dataset 2, in the published schema of its tables.

One table per component, named by the fields of the component and its key. Types are those of the
schema: transforms are fixed lists of 16 float64, images binary, range images lists of float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

SEGMENT = "10023947602400723454_1120_000_1140_000"
OPENCV_FROM_CAMERA = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
TRANSFORM = pa.list_(pa.float64(), 16)
IMAGE_SHAPE = pa.list_(pa.int32(), 3)
KEY = {"key.segment_context_name": pa.string()}
TIMED = {**KEY, "key.frame_timestamp_micros": pa.int64()}
LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")


def range_image(component: str) -> dict[str, pa.DataType]:
    first = f"[{component}].range_image_return1"
    return {f"{first}.values": pa.list_(pa.float32()), f"{first}.shape": IMAGE_SHAPE}


SCHEMAS: dict[str, dict[str, pa.DataType]] = {
    "camera_image": {
        **TIMED,
        "key.camera_name": pa.int8(),
        "[CameraImageComponent].image": pa.binary(),
        "[CameraImageComponent].pose.transform": TRANSFORM,
    },
    "camera_calibration": {
        **KEY,
        "key.camera_name": pa.int8(),
        **{f"[CameraCalibrationComponent].intrinsic.{key}": pa.float64() for key in LENS},
        "[CameraCalibrationComponent].extrinsic.transform": TRANSFORM,
        "[CameraCalibrationComponent].width": pa.int32(),
        "[CameraCalibrationComponent].height": pa.int32(),
        "[CameraCalibrationComponent].rolling_shutter_direction": pa.int8(),
    },
    "vehicle_pose": {**TIMED, "[VehiclePoseComponent].world_from_vehicle.transform": TRANSFORM},
    "lidar": {**TIMED, "key.laser_name": pa.int8(), **range_image("LiDARComponent")},
    "lidar_pose": {**TIMED, "key.laser_name": pa.int8(), **range_image("LiDARPoseComponent")},
    "lidar_calibration": {
        **KEY,
        "key.laser_name": pa.int8(),
        "[LiDARCalibrationComponent].extrinsic.transform": TRANSFORM,
        "[LiDARCalibrationComponent].beam_inclination.min": pa.float64(),
        "[LiDARCalibrationComponent].beam_inclination.max": pa.float64(),
        "[LiDARCalibrationComponent].beam_inclination.values": pa.list_(pa.float64()),
    },
    "lidar_box": {
        **TIMED,
        "key.laser_object_id": pa.string(),
        **{f"[LiDARBoxComponent].box.center.{axis}": pa.float64() for axis in "xyz"},
        **{f"[LiDARBoxComponent].box.size.{axis}": pa.float64() for axis in "xyz"},
        "[LiDARBoxComponent].box.heading": pa.float64(),
        "[LiDARBoxComponent].type": pa.int8(),
        **{f"[LiDARBoxComponent].speed.{axis}": pa.float64() for axis in "xyz"},
    },
}
"""Columns of each component with cameras, depth and boxes."""


@dataclass(frozen=True)
class RigCamera:
    """A camera on the vehicle."""

    number: int
    lens: tuple[float, ...]
    """Values named by `LENS`."""
    size: tuple[int, int]
    vehicle_from_camera: np.ndarray
    """Pose in Waymo's axes: x forward, y left, z up."""


@dataclass(frozen=True)
class Laser:
    """A laser on the vehicle."""

    number: int
    vehicle_from_laser: np.ndarray
    low: float
    high: float
    values: tuple[float, ...] | None = None
    """Ascending inclinations; None if uniform."""


@dataclass(frozen=True)
class Seen:
    """A box around an object, in the vehicle frame."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    heading: float
    kind: int
    speed: tuple[float, float, float] | None


@dataclass(frozen=True)
class Moment:
    """Record of the vehicle at one time."""

    time: int
    world_from_vehicle: np.ndarray
    images: dict[int, bytes]
    """Photographs by camera number."""
    ranges: dict[int, np.ndarray]
    """[h, w] by laser number, -1 without a return."""
    pixel_poses: np.ndarray | None = None
    """[h, w, 6] of laser 1: roll, pitch, yaw, x, y, z of the vehicle in the world."""
    boxes: tuple[Seen, ...] = ()


def write_segment(
    root: Path,
    moments: Sequence[Moment],
    cameras: Sequence[RigCamera],
    lasers: Sequence[Laser] = (),
    name: str = SEGMENT,
) -> Path:
    """Write a segment; components without rows are left out."""
    rows: dict[str, list[dict[str, object]]] = {component: [] for component in SCHEMAS}
    for camera in cameras:
        rows["camera_calibration"].append(_camera_row(camera, name))
    for laser in lasers:
        rows["lidar_calibration"].append(_laser_row(laser, name))
    for moment in moments:
        for component, row in _rows(moment, name):
            rows[component].append(row)
    for component, found in rows.items():
        if found:
            (root / component).mkdir(parents=True, exist_ok=True)
            table = pa.Table.from_pylist(found, pa.schema(list(SCHEMAS[component].items())))
            parquet.write_table(table, root / component / f"{name}.parquet", row_group_size=4)
    return root


def _camera_row(camera: RigCamera, name: str) -> dict[str, object]:
    prefix = "[CameraCalibrationComponent]"
    lens = zip(LENS, camera.lens, strict=True)
    return {
        "key.segment_context_name": name,
        "key.camera_name": camera.number,
        **{f"{prefix}.intrinsic.{key}": value for key, value in lens},
        f"{prefix}.extrinsic.transform": camera.vehicle_from_camera.ravel().tolist(),
        f"{prefix}.width": camera.size[0],
        f"{prefix}.height": camera.size[1],
        f"{prefix}.rolling_shutter_direction": 4,
    }


def _laser_row(laser: Laser, name: str) -> dict[str, object]:
    prefix = "[LiDARCalibrationComponent]"
    return {
        "key.segment_context_name": name,
        "key.laser_name": laser.number,
        f"{prefix}.extrinsic.transform": laser.vehicle_from_laser.ravel().tolist(),
        f"{prefix}.beam_inclination.min": laser.low,
        f"{prefix}.beam_inclination.max": laser.high,
        f"{prefix}.beam_inclination.values": None if laser.values is None else list(laser.values),
    }


def _rows(moment: Moment, name: str) -> list[tuple[str, dict[str, object]]]:
    key = {"key.segment_context_name": name, "key.frame_timestamp_micros": moment.time}
    pose = moment.world_from_vehicle.ravel().tolist()
    rows: list[tuple[str, dict[str, object]]] = [
        ("vehicle_pose", {**key, "[VehiclePoseComponent].world_from_vehicle.transform": pose})
    ]
    for number, image in moment.images.items():
        row = {"[CameraImageComponent].image": image, "[CameraImageComponent].pose.transform": pose}
        rows.append(("camera_image", {**key, "key.camera_name": number, **row}))
    for number, ranges in moment.ranges.items():
        channels = np.stack([ranges, *[np.zeros_like(ranges)] * 3], axis=-1)
        columns = _image_columns("LiDARComponent", channels)
        rows.append(("lidar", {**key, "key.laser_name": number, **columns}))
    if moment.pixel_poses is not None:
        columns = _image_columns("LiDARPoseComponent", moment.pixel_poses)
        rows.append(("lidar_pose", {**key, "key.laser_name": 1, **columns}))
    boxes = [("lidar_box", {**key, **_box(box, n)}) for n, box in enumerate(moment.boxes)]
    return rows + boxes


def _image_columns(component: str, image: np.ndarray) -> dict[str, object]:
    first = f"[{component}].range_image_return1"
    return {f"{first}.values": image.ravel().tolist(), f"{first}.shape": list(image.shape)}


def _box(box: Seen, number: int) -> dict[str, object]:
    prefix = "[LiDARBoxComponent]"
    speed = (None, None, None) if box.speed is None else box.speed
    return {
        "key.laser_object_id": f"object-{number}",
        **{f"{prefix}.box.center.{a}": v for a, v in zip("xyz", box.center, strict=True)},
        **{f"{prefix}.box.size.{a}": v for a, v in zip("xyz", box.size, strict=True)},
        f"{prefix}.box.heading": box.heading,
        f"{prefix}.type": box.kind,
        **{f"{prefix}.speed.{a}": v for a, v in zip("xyz", speed, strict=True)},
    }
