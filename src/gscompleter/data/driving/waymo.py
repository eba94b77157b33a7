"""Segments of the Waymo Open Dataset, version 2: a parquet file per component and segment.

The files are read through pyarrow (`pip install 'gscompleter[waymo]'`).

`camera_image/SEGMENT.parquet` holds the photographs, a row per camera and time, with the vehicle
pose; `camera_calibration` the cameras. If present, `lidar`, `lidar_calibration`, `lidar_pose` and
`vehicle_pose` give sparse depth, and `lidar_box` moving objects. Axes of vehicle and cameras are x
forward, y left, z up.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.driving.lidar import build_poses, compute_points, transform_points
from gscompleter.data.driving.moving_objects import Box, build_upright_pose, convert_speed
from gscompleter.data.frame import Frame
from gscompleter.data.limits import MAX_SIDE
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.data.undistort import Distortion
from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import check_file

ADVICE = "download it again"
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

PosedLens = tuple[Intrinsics, Float[np.ndarray, "4 4"]]
"""Intrinsics of a camera, and its pose on the vehicle in Waymo's axes."""

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
        self, component: str, columns: dict[str, str], where: Mapping[str, int] | None = None
    ) -> Iterator[dict[str, Any]]:
        """Read rows of a component as dicts with the keys of `columns`.

        Only rows where the columns of `where` have these values are read. Lists of numbers become
        arrays; null becomes None.
        """
        path = self.get_path(component)
        table = _read_table(path, list(columns.values()), where or {})
        values = [[_to_plain(value) for value in table.column(name)] for name in columns.values()]
        return (dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True))


def _read_table(path: Path, columns: Sequence[str], where: Mapping[str, int]) -> Any:
    try:
        import pyarrow
        from pyarrow import dataset
    except ImportError as error:
        raise InputError(
            f"{quote_value(path)} is a parquet file, and pyarrow is not installed; run "
            "`pip install 'gscompleter[waymo]'`."
        ) from error
    check_file(path)
    try:
        table = dataset.dataset(path, format="parquet")
        absent = [name for name in (*columns, *where) if name not in table.schema.names]
        if absent:
            raise InputError(
                f"{quote_value(path)} has no column {quote_value(absent[0])}; {ADVICE}."
            )
        keep = None
        for column, value in where.items():
            same = dataset.field(column) == value
            keep = same if keep is None else keep & same
        return table.to_table(columns, filter=keep, use_threads=False)
    except (pyarrow.ArrowException, OSError, UnicodeDecodeError) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(
            f"{quote_value(path)} cannot be read ({quote_value(lines[0])}); {ADVICE}."
        ) from error


def _to_plain(scalar: Any) -> Any:
    """Convert to a Python value, and a list of numbers to an array."""
    if not scalar.is_valid:
        return None
    values = getattr(scalar, "values", None)
    return scalar.as_py() if values is None else values.to_numpy(zero_copy_only=False)


def _open_segment(segment: Segment) -> Photographs:
    file = segment.get_path(IMAGES)
    columns = {"time": TIME, "camera": CAMERA, "pose": "[CameraImageComponent].pose.transform"}
    cameras = _read_cameras(segment)
    rows = [row for row in segment.read_rows(IMAGES, columns) if row["camera"] in CAMERAS]
    rows.sort(key=lambda row: (row["camera"], row["time"]))
    if not rows:
        raise InputError(f"{quote_value(file)} holds no photographs; {ADVICE}.")
    frames = [_make_frame(segment, cameras, **row) for row in rows]
    return build_drive(segment.name, str(file), frames, front=CAMERAS[1])


def _make_frame(
    segment: Segment, cameras: dict[int, PosedLens], time: int, camera: int, pose: Any
) -> Frame:
    file, name = quote_value(segment.get_path(IMAGES)), CAMERAS[camera]
    title = f"the photograph of {name} at {time} in {file}"
    if camera not in cameras:
        raise InputError(f"The camera of {title} has no calibration; {ADVICE}.")
    intrinsics, vehicle_from_camera = cameras[camera]
    measured = segment.has_components("lidar", "lidar_calibration", "vehicle_pose")
    boxed = segment.has_components("lidar_box", "vehicle_pose")
    return Frame(
        f"{name}/{time}",
        title,
        _parse_matrix(pose, title) @ vehicle_from_camera @ CAMERA_FROM_OPENCV,
        intrinsics,
        partial(_read_image, segment, time, camera),
        sensor=name,
        laser_points=partial(_read_points, segment, time) if measured else None,
        boxes=partial(_read_boxes, segment, time) if boxed else None,
    )


def _read_cameras(segment: Segment) -> dict[int, PosedLens]:
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
    radial, tangential = (row["k1"], row["k2"], row["k3"]), (row["p1"], row["p2"])
    distortion = Distortion(radial=radial, tangential=tangential)
    focal, center = (row["f_u"], row["f_v"]), (row["c_u"], row["c_v"])
    return Intrinsics(size, focal, center, distortion=distortion)


def _read_image(segment: Segment, time: int, camera: int) -> bytes:
    columns, where = {"image": "[CameraImageComponent].image"}, {TIME: time, CAMERA: camera}
    found = [row["image"] for row in segment.read_rows(IMAGES, columns, where)]
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
    file = segment.get_path("lidar")
    for row in segment.read_rows("lidar", columns, {TIME: time}):
        laser, image = row["laser"], _reshape_image(row, file)
        if image is None:
            continue
        ranges, poses = image[..., 0], turning.get(laser, vehicle)
        if laser not in lasers or not _is_consistent(ranges, lasers[laser][0], poses):
            raise InputError(
                f"Laser {laser} of {quote_value(file)} does not fit its calibration or its poses; "
                f"{ADVICE}."
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
    values, low, high = beams
    if values is None:
        values = low + (np.arange(len(ranges)) + 0.5) / len(ranges) * (high - low)
    local = compute_points(ranges, values[::-1], extrinsic)
    hit = np.isfinite(ranges) & (ranges > 0)
    return transform_points(local[hit], vehicle if vehicle.ndim == 2 else vehicle[hit])


def _read_vehicle_pose(segment: Segment, time: int) -> Float[np.ndarray, "4 4"]:
    title = str(segment.get_path("vehicle_pose"))
    columns = {"pose": "[VehiclePoseComponent].world_from_vehicle.transform"}
    rows = list(segment.read_rows("vehicle_pose", columns, {TIME: time}))
    if len(rows) != 1:
        raise InputError(f"{title} has {len(rows)} poses at {time}; {ADVICE}.")
    return _parse_matrix(rows[0]["pose"], title)


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
        for row in segment.read_rows("lidar_pose", columns, {TIME: time})
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
    rows = segment.read_rows("lidar_box", columns, {TIME: time})
    return tuple(_parse_box(row, vehicle) for row in rows if row["type"] != SIGN)


def _parse_box(row: dict[str, Any], vehicle: Float[np.ndarray, "4 4"]) -> Box:
    def read(key: str) -> Float[np.ndarray, "3"]:
        return np.array([row[f"{key}_{axis}"] for axis in "xyz"], dtype=np.float64)

    length, width, height = read("size").tolist()
    pose = vehicle @ build_upright_pose(read("center"), np.float64(row["heading"]))
    return Box(pose, (length, width, height), convert_speed(read("speed")))


def _parse_matrix(values: Any, title: str) -> Float[np.ndarray, "4 4"]:
    if values is None or len(values) != 16 or not np.isfinite(values).all():
        raise InputError(f"A transform in {title} is damaged; {ADVICE}.")
    return np.asarray(values, dtype=np.float64).reshape(4, 4)
