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
COMPONENTS = {
    IMAGES: "CameraImageComponent",
    "camera_calibration": "CameraCalibrationComponent",
    "lidar": "LiDARComponent",
    "lidar_calibration": "LiDARCalibrationComponent",
    "lidar_pose": "LiDARPoseComponent",
    "vehicle_pose": "VehiclePoseComponent",
    "lidar_box": "LiDARBoxComponent",
}
"""Prefixes of the columns of each component."""
TIME, CAMERA, LASER = "key.frame_timestamp_micros", "key.camera_name", "key.laser_name"
LENS = ("width", "height", *(f"intrinsic.{name}" for name in ("f_u", "f_v", "c_u", "c_v")))
LENS_DISTORTION = tuple(f"intrinsic.{name}" for name in ("k1", "k2", "k3", "p1", "p2"))
CAMERAS = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
"""Camera names by their numbers in the tables."""
SIGN = 3
"""Box type of signs, which never move."""
CAMERA_FROM_OPENCV = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Axis change from x right, y down, z forward to x forward, y left, z up."""

Beams = tuple[Float[np.ndarray, "h"] | None, float | None, float | None]
"""Beam elevations of a laser in radians, ascending, and their lower and upper end."""
PosedLens = tuple[Intrinsics, Float[np.ndarray, "4 4"]]
"""Intrinsics of a camera, and its pose on the vehicle in Waymo's axes."""


def has_waymo(path: Path) -> bool:
    """Check whether `path` is a folder of segments, or the photographs of one."""
    if os.path.isdir(path):
        return any((path / IMAGES).glob("*.parquet"))
    return path.suffix == ".parquet" and path.parent.name == IMAGES and os.path.isfile(path)


def open_waymo(path: Path) -> Iterator[Photographs]:
    """Open the segments in a folder, or the named one.

    Frames are numbered camera by camera, the front camera first, and by time.
    """
    files = sorted((path / IMAGES).glob("*.parquet")) if os.path.isdir(path) else [path]
    return (_open_segment(Segment(file.parent.parent, file.stem)) for file in files)


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
        self, component: str, columns: Sequence[str], where: Mapping[str, int] | None = None
    ) -> Iterator[tuple[Any, ...]]:
        """Read columns of a component, named without its prefix, row by row.

        Only rows where the columns of `where` have these values are read. Lists of numbers become
        arrays; null becomes None.
        """
        prefix = f"[{COMPONENTS[component]}]."
        names = [name if name.startswith("key.") else prefix + name for name in columns]
        table = _read_table(self.get_path(component), names, where or {})
        values = [[_to_plain(value) for value in table.column(name)] for name in names]
        return zip(*values, strict=True)


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
    file, cameras = segment.get_path(IMAGES), _read_cameras(segment)
    rows = segment.read_rows(IMAGES, (CAMERA, TIME, "pose.transform"))
    shown = sorted((row for row in rows if row[0] in CAMERAS), key=lambda row: row[:2])
    if not shown:
        raise InputError(f"{quote_value(file)} holds no photographs; {ADVICE}.")
    frames = [_make_frame(segment, cameras, *row) for row in shown]
    return build_drive(segment.name, str(file), frames, front=CAMERAS[1])


def _make_frame(
    segment: Segment, cameras: dict[int, PosedLens], camera: int, time: int, pose: Any
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
    columns = (CAMERA, "extrinsic.transform", *LENS, *LENS_DISTORTION)
    title = str(segment.get_path("camera_calibration"))
    return {
        camera: (_parse_intrinsics(numbers, title), _parse_matrix(pose, title))
        for camera, pose, *numbers in segment.read_rows("camera_calibration", columns)
    }


def _parse_intrinsics(numbers: Sequence[Any], title: str) -> Intrinsics:
    known = [number for number in numbers if number is not None and np.isfinite(number)]
    if len(known) < len(numbers):
        raise InputError(f"A camera in {title} lacks intrinsics; {ADVICE}.")
    width, height, f_u, f_v, c_u, c_v, k1, k2, k3, p1, p2 = known
    size = (int(width), int(height))
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise InputError(f"A camera in {title} has images of {size} pixels; {ADVICE}.")
    distortion = Distortion(radial=(k1, k2, k3), tangential=(p1, p2))
    return Intrinsics(size, (f_u, f_v), (c_u, c_v), distortion=distortion)


def _read_image(segment: Segment, time: int, camera: int) -> bytes:
    columns, where = ("image",), {TIME: time, CAMERA: camera}
    found = [image for (image,) in segment.read_rows(IMAGES, columns, where)]
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
    vehicle, lasers = _read_vehicle_pose(segment, time), _read_lasers(segment)
    turning = segment.has_components("lidar_pose")
    poses = _read_range_images(segment, "lidar_pose", time) if turning else {}
    points = [np.zeros((0, 3))]
    for laser, image in _read_range_images(segment, "lidar", time).items():
        ranges = image[..., 0]
        beams, extrinsic = lasers.get(laser, ((None, None, None), np.eye(4)))
        elevations = _compute_elevations(beams, len(ranges))
        pose = build_poses(poses[laser]) if laser in poses else vehicle
        if elevations is None or (pose.ndim > 2 and pose.shape[:2] != ranges.shape):
            raise InputError(
                f"Laser {laser} of {quote_value(segment.get_path('lidar'))} does not fit its "
                f"calibration or its poses; {ADVICE}."
            )
        hit = np.isfinite(ranges) & (ranges > 0)
        local = compute_points(ranges, elevations, extrinsic)[hit]
        points.append(transform_points(local, pose if pose.ndim == 2 else pose[hit]))
    return np.concatenate(points)


def _compute_elevations(beams: Beams, height: int) -> Float[np.ndarray, "h"] | None:
    """Compute the elevation of each row in radians, highest first; None if `beams` do not fit."""
    values, low, high = beams
    if values is not None:
        return values[::-1] if len(values) == height else None
    if low is None or high is None:
        return None
    return (low + (np.arange(height) + 0.5) / height * (high - low))[::-1]


def _read_vehicle_pose(segment: Segment, time: int) -> Float[np.ndarray, "4 4"]:
    title = str(segment.get_path("vehicle_pose"))
    columns = ("world_from_vehicle.transform",)
    rows = list(segment.read_rows("vehicle_pose", columns, {TIME: time}))
    if len(rows) != 1:
        raise InputError(f"{title} has {len(rows)} poses at {time}; {ADVICE}.")
    return _parse_matrix(rows[0][0], title)


def _read_lasers(segment: Segment) -> dict[int, tuple[Beams, Float[np.ndarray, "4 4"]]]:
    """Read the beams of each laser, and its pose on the vehicle."""
    beams = (f"beam_inclination.{name}" for name in ("values", "min", "max"))
    rows = segment.read_rows("lidar_calibration", (LASER, "extrinsic.transform", *beams))
    title = str(segment.get_path("lidar_calibration"))
    return {
        laser: ((values, low, high), _parse_matrix(pose, title))
        for laser, pose, values, low, high in rows
    }


def _read_range_images(
    segment: Segment, component: str, time: int
) -> dict[int, Float[np.ndarray, "h w c"]]:
    """Read the range image of the first returns, or the poses of its pixels, by laser."""
    columns = (LASER, "range_image_return1.values", "range_image_return1.shape")
    found = {}
    for laser, values, shape in segment.read_rows(component, columns, {TIME: time}):
        if values is None or shape is None:
            continue
        if len(shape) != 3 or any(side < 1 for side in shape) or len(values) != np.prod(shape):
            file = quote_value(segment.get_path(component))
            raise InputError(f"A range image in {file} is damaged; {ADVICE}.")
        found[laser] = np.asarray(values, dtype=np.float64).reshape(shape)
    return found


def _read_boxes(segment: Segment, time: int) -> tuple[Box, ...]:
    """Read the boxes of objects around the vehicle, except signs."""
    vehicle = _read_vehicle_pose(segment, time)
    vectors = ("box.center", "box.size", "speed")
    columns = ["type", "box.heading", *(f"{name}.{axis}" for name in vectors for axis in "xyz")]
    boxes = []
    for kind, heading, *numbers in segment.read_rows("lidar_box", columns, {TIME: time}):
        if kind != SIGN:
            center, sides, velocity = np.array(numbers, dtype=np.float64).reshape(3, 3)
            pose = vehicle @ build_upright_pose(center, np.float64(heading))
            length, width, height = sides.tolist()
            boxes.append(Box(pose, (length, width, height), convert_speed(velocity)))
    return tuple(boxes)


def _parse_matrix(values: Any, title: str) -> Float[np.ndarray, "4 4"]:
    if values is None or len(values) != 16 or not np.isfinite(values).all():
        raise InputError(f"A transform in {title} is damaged; {ADVICE}.")
    return np.asarray(values, dtype=np.float64).reshape(4, 4)
