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
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Distortion, Intrinsics
from gscompleter.data.driving.vehicle import build_poses, compute_moving_boxes, transform_points
from gscompleter.data.frame import Frame, capitalize
from gscompleter.data.limits import require
from gscompleter.data.photograph import StoredPhotograph
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import check_file, list_entries

WAYMO_ADVICE = "download it again"
IMAGE_COMPONENT = "camera_image"
TIME = "key.frame_timestamp_micros"
CAMERA = "key.camera_name"
LASER = "key.laser_name"
INTRINSICS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "k3", "p1", "p2")
LENS_COLUMNS = ("width", "height", *(f"intrinsic.{name}" for name in INTRINSICS))
CAMERA_NAMES = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
"""Camera names by their numbers in the tables."""
SIGN = 3
"""Box type of signs, which never move."""
CAMERA_FROM_OPENCV = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Axis change from x right, y down, z forward to x forward, y left, z up."""

PosedLens = tuple[Intrinsics, Float[np.ndarray, "4 4"]]
"""Intrinsics of a camera, and its pose on the vehicle in Waymo's axes."""


def open_waymo(path: Path) -> Iterator[Photographs]:
    """Open segments; frames are numbered by camera, the front camera first, and time."""
    return (_open_segment(segment) for segment in list_segments(path))


def list_segments(path: Path) -> list[Path]:
    """List the photograph files of the segments in a folder, or the given one."""
    files = list_entries(path / IMAGE_COMPONENT, "*.parquet") if os.path.isdir(path) else [path]
    return [f for f in files if f.match(f"{IMAGE_COMPONENT}/*.parquet") and os.path.isfile(f)]


def _locate_component(segment: Path, component: str) -> Path:
    """Return the file of a component; `segment` is that of the photographs."""
    return segment.parent.parent / component / segment.name


def _has_components(segment: Path, *components: str) -> bool:
    return all(os.path.isfile(_locate_component(segment, component)) for component in components)


def _read_table_rows(
    path: Path, columns: Sequence[str], where: Mapping[str, int] | None = None
) -> list[tuple[Any, ...]]:
    """Read columns of a file, named without their prefix, as rows of plain values.

    Only rows where the columns of `where` have these values are read.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise InputError(
            f"{quote_value(path)} is a parquet file, and pyarrow is not installed; run "
            "`pip install 'gscompleter[waymo]'`."
        ) from error
    check_file(path)
    filters = [(column, "==", value) for column, value in (where or {}).items()] or None
    try:
        # Columns are called "[CameraImageComponent].image", with the name of the component in
        # brackets.
        stored = {name.rpartition("].")[2]: name for name in parquet.read_schema(path).names}
        names = [stored.get(column, column) for column in columns]
        table = parquet.read_table(path, columns=names, filters=filters, partitioning=None)
    except (pyarrow.ArrowException, OSError, UnicodeDecodeError) as error:
        raise InputError(f"{quote_value(path)} cannot be read; {WAYMO_ADVICE}.") from error
    return [tuple(row[name] for name in names) for row in table.to_pylist()]


def _read_value(path: Path, column: str, where: Mapping[str, int]) -> Any:
    """Read the value of a column in the only row where other columns have these values."""
    values = [value for (value,) in _read_table_rows(path, (column,), where) if value]
    require(len(values) == 1, f"{quote_value(path)} lacks a {column} of a frame; {WAYMO_ADVICE}.")
    return values[0]


def _open_segment(segment: Path) -> Photographs:
    cameras = _read_cameras(_locate_component(segment, "camera_calibration"))
    rows = _read_table_rows(segment, (CAMERA, TIME, "pose.transform"))
    shown = sorted((row for row in rows if row[0] in CAMERA_NAMES), key=lambda row: row[:2])
    require(shown, f"{quote_value(segment)} holds no photographs; {WAYMO_ADVICE}.")
    frames = [_make_waymo_frame(segment, cameras, *row) for row in shown]
    return build_drive(segment.stem, quote_value(segment), frames, front=CAMERA_NAMES[1])


def _make_waymo_frame(
    segment: Path, cameras: dict[int, PosedLens], camera: int, time: int, pose: Any
) -> Frame:
    name = CAMERA_NAMES[camera]
    title = f"the photograph of {name} at {time} in {quote_value(segment)}"
    require(camera in cameras, f"The camera of {title} has no calibration; {WAYMO_ADVICE}.")
    intrinsics, vehicle_from_camera = cameras[camera]

    # Components are downloaded one by one, and only the first two are needed.
    laser_points = None
    if _has_components(segment, "lidar", "lidar_calibration", "vehicle_pose"):
        laser_points = partial(_read_segment_points, segment, time)
    boxes = None
    if _has_components(segment, "lidar_box", "vehicle_pose"):
        boxes = partial(_read_segment_boxes, segment, time)
    return Frame(
        f"{name}/{time}",
        title,
        _parse_matrix(pose, title) @ vehicle_from_camera @ CAMERA_FROM_OPENCV,
        intrinsics,
        StoredPhotograph(
            partial(_read_value, segment, "image", {TIME: time, CAMERA: camera}), capitalize(title)
        ),
        sensor=name,
        laser_points=laser_points,
        boxes=boxes,
    )


def _read_cameras(path: Path) -> dict[int, PosedLens]:
    title = quote_value(path)
    cameras = {}
    for camera, pose, *numbers in _read_table_rows(
        path, (CAMERA, "extrinsic.transform", *LENS_COLUMNS)
    ):
        lens = np.array(numbers, dtype=np.float64)  # null becomes NaN
        require(
            np.isfinite(lens).all() and (lens[:2] >= 1).all(),
            f"Camera {camera} in {title} has no size or no intrinsics; {WAYMO_ADVICE}.",
        )
        width, height, f_u, f_v, c_u, c_v, *radial, p1, p2 = lens.tolist()
        distortion = Distortion(radial=tuple(radial), tangential=(p1, p2))
        size = (int(width), int(height))
        intrinsics = Intrinsics(size, (f_u, f_v), (c_u, c_v), distortion=distortion)
        cameras[camera] = intrinsics, _parse_matrix(pose, title)
    return cameras


@lru_cache(maxsize=2)
def _read_segment_points(segment: Path, time: int) -> Float[np.ndarray, "n 3"]:
    """Read the first laser returns in the world frame, in metres.

    The roof laser rotates while the vehicle drives; `lidar_pose` has the vehicle pose per pixel.
    """
    world_from_vehicle = _read_vehicle_pose(segment, time)
    # Of each laser its pose on the vehicle, its beams, and their lower and upper end.
    calibration = _locate_component(segment, "lidar_calibration")
    beams = (f"beam_inclination.{name}" for name in ("values", "min", "max"))
    rows = _read_table_rows(calibration, (LASER, "extrinsic.transform", *beams))
    lasers = {
        laser: (_parse_matrix(pose, quote_value(calibration)), *inclinations)
        for laser, pose, *inclinations in rows
    }

    measured = _locate_component(segment, "lidar")
    turning = _locate_component(segment, "lidar_pose")
    poses = _read_range_images(turning, time) if os.path.isfile(turning) else {}
    points = [np.zeros((0, 3))]
    for laser, image in _read_range_images(measured, time).items():
        title = f"laser {laser} of {quote_value(measured)}"
        ranges = image[..., 0]
        moving = poses.get(laser)
        fits = laser in lasers and (moving is None or moving.shape == (*ranges.shape, 6))
        require(fits, f"The {title} does not fit its calibration or its poses; {WAYMO_ADVICE}.")
        # A range of 0 or below is a beam that did not return.
        hit = np.isfinite(ranges) & (ranges > 0)
        local = _compute_points(title, ranges, *lasers[laser])[hit]
        # Without `lidar_pose` the vehicle is taken to stand still during the turn.
        pose = world_from_vehicle if moving is None else build_poses(moving[hit])
        points.append(transform_points(local, pose))
    return np.concatenate(points)


def _compute_points(
    title: str,
    ranges: Float[np.ndarray, "h w"],
    extrinsic: Float[np.ndarray, "4 4"],
    beams: Sequence[float] | None,
    low: float | None,
    high: float | None,
) -> Float[np.ndarray, "h w 3"]:
    """Compute the points (metres) of a range image in the vehicle frame.

    It has one row per beam, the highest first, and one column per direction. Columns begin behind
    the laser and turn clockwise as seen from above. `beams` are the elevations in radians,
    ascending, by default evenly spaced from `low` to `high`; `extrinsic` is the pose of the laser.
    """
    height, width = ranges.shape
    # Elevations are listed from the lowest beam, and rows begin with the highest.
    rising = np.array(beams, dtype=np.float64)
    if beams is None and low is not None and high is not None:
        rising = low + (np.arange(height) + 0.5) / height * (high - low)
    require(rising.size == height, f"The {title} does not fit its calibration; {WAYMO_ADVICE}.")
    # As in Waymo's `range_image_utils`: azimuths count from behind, in the frame of the vehicle, so
    # the yaw of the laser is taken off.
    yaw = np.arctan2(extrinsic[1, 0], extrinsic[0, 0])
    azimuths = np.pi * (1 - 2 * (np.arange(width) + 0.5) / width) - yaw
    level = np.cos(rising[::-1, None])
    up = np.broadcast_to(np.sin(rising[::-1, None]), ranges.shape)
    rays = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), up], axis=-1)
    return transform_points(ranges[..., None] * rays, extrinsic)


def _read_vehicle_pose(segment: Path, time: int) -> Float[np.ndarray, "4 4"]:
    path = _locate_component(segment, "vehicle_pose")
    values = _read_value(path, "world_from_vehicle.transform", {TIME: time})
    return _parse_matrix(values, quote_value(path))


def _read_range_images(path: Path, time: int) -> dict[int, Float[np.ndarray, "h w c"]]:
    """Read the range image of the first returns, or the poses of its pixels, by laser."""
    columns = (LASER, "range_image_return1.values", "range_image_return1.shape")
    images = {}
    for laser, values, shape in _read_table_rows(path, columns, {TIME: time}):
        if values is not None and shape is not None:
            fits = len(shape) == 3 and min(shape) > 0 and len(values) == np.prod(shape)
            require(fits, f"A range image in {quote_value(path)} is damaged; {WAYMO_ADVICE}.")
            images[laser] = np.asarray(values, dtype=np.float64).reshape(shape)
    return images


def _read_segment_boxes(segment: Path, time: int) -> Float[np.ndarray, "n 8 3"]:
    """Read the boxes of moving objects around the vehicle, except signs."""
    world_from_vehicle = _read_vehicle_pose(segment, time)
    center = [f"box.center.{axis}" for axis in "xyz"]
    size = [f"box.size.{axis}" for axis in "xyz"]
    speed = [f"speed.{axis}" for axis in "xyz"]
    columns = ["type", *center, *size, "box.heading", *speed]
    rows = _read_table_rows(_locate_component(segment, "lidar_box"), columns, {TIME: time})
    objects = [numbers for kind, *numbers in rows if kind != SIGN]
    return compute_moving_boxes(
        world_from_vehicle, np.array(objects, dtype=np.float64).reshape(-1, 10)
    )


def _parse_matrix(values: Any, title: str) -> Float[np.ndarray, "4 4"]:
    matrix = np.array(values, dtype=np.float64)  # null becomes NaN
    fits = matrix.size == 16 and np.isfinite(matrix).all()
    require(fits, f"A transform in {title} is damaged; {WAYMO_ADVICE}.")
    return matrix.reshape(4, 4)
