"""A Waymo segment of a real road: photographs and poses of `kitti_city`, and laser points.

KITTI's camera is 1.65 m above the road. The "laser" measures a flat road near the vehicle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gscompleter.data.driving.vehicle import build_poses
from gscompleter.data.formats import open_photographs
from waymo_segment import OPENCV_FROM_CAMERA, Laser, Moment, RigCamera, Seen, write_segment

ABOVE_ROAD = 1.65
MOUNTED = build_poses(np.array([0.0, 0.0, 0.0, 1.6, 0.0, ABOVE_ROAD]))
LASER = Laser(1, build_poses(np.array([0.0, 0.0, 0.0, 1.2, 0.0, 2.0])), -0.5, 0.05)


def road_ahead(shape: tuple[int, int] = (48, 720)) -> np.ndarray:
    """Compute ranges to a flat road within 3 m of the lane and 5 to 15 m ahead; -1 elsewhere."""
    h, w = shape
    down = np.linspace(LASER.high, LASER.low, 2 * h + 1)[1::2, None]
    azimuth = np.pi * (1 - 2 * (np.arange(w) + 0.5) / w)[None]
    ranges = LASER.vehicle_from_laser[2, 3] / np.maximum(-np.sin(down), 1e-6)
    x, y = (ranges * np.cos(down) * turn(azimuth) for turn in (np.cos, np.sin))
    return np.where((x > 5) & (x < 15) & (np.abs(y) < 3), ranges, -1.0)


def kitti_city_segment(
    shared: Path, root: Path, count: int = 8, boxes: tuple[Seen, ...] = ()
) -> Path:
    """Write the first photographs of `kitti_city` as a segment."""
    photographs = open_photographs(shared / "data" / "kitti_city")
    pinhole = photographs.frames[0].intrinsics
    lens = (*pinhole.focal, *pinhole.center, 0.0, 0.0, 0.0, 0.0, 0.0)
    camera = RigCamera(1, lens, pinhole.size, MOUNTED)
    moments = [
        Moment(
            100_000 * number,
            frame.c2w @ OPENCV_FROM_CAMERA @ np.linalg.inv(MOUNTED),
            {1: frame.file.path.read_bytes()},
            {1: road_ahead()},
            boxes=boxes,
        )
        for number, frame in enumerate(photographs.frames[:count])
    ]
    return write_segment(root, moments, [camera], [LASER])
