"""Infos of mmdetection3d 1.1, for nuScenes and for Waymo in KITTI's layout.

A pickle lists samples: the vehicle pose, and image, intrinsics and pose of each camera. Consecutive
samples of one drive make a scene.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.driving.restricted_pickle import load_plain
from gscompleter.data.driving.vehicle import Box, build_box
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import get_array, get_number, get_part, get_size, get_text
from gscompleter.data.limits import require
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.errors import quote_value

ADVICE = "write the infos again with mmdetection3d 1.1"
FRONT = "CAM_FRONT"
NEEDED = ("img_path", "cam2img", "lidar2cam")
"""Entries of an image that has a file and a pose."""
MAX_GAP = 1.5
"""Largest gap between samples of a scene, in seconds; nuScenes has 0.5."""
MICROSECONDS = 1e12
"""Smallest time that is in microseconds."""
MAX_TIME = 1e18
"""Largest time in either unit."""

Pose = Float[np.ndarray, "4 4"]


def has_infos(path: Path) -> bool:
    """Check whether `path` is a pickle."""
    return path.suffix == ".pkl" and os.path.isfile(path)


def open_infos(path: Path) -> Iterator[Photographs]:
    """Open the scenes of a pickle, named by drive and start time.

    Frames are numbered camera by camera, the front camera first, and by time. Images are searched
    beside the pickle and below it.
    """
    content = get_part(load_plain(path), "data_list", list)
    require(content, f"{quote_value(path)} holds no infos with a `data_list`; {ADVICE}.")
    samples = sorted((_parse_sample(s, path) for s in content), key=lambda s: (s.drive, s.time))
    return (_build_scene(path, scene) for scene in _split_scenes(samples))


@dataclass(frozen=True)
class _Sample:
    """Record of the vehicle at one time."""

    drive: str
    time: float
    """Time in seconds."""
    frames: dict[str, Frame]
    """Frames by camera."""


def _parse_sample(sample: Any, path: Path) -> _Sample:
    title = f"a sample of {quote_value(path)}"
    images = {
        quote_value(name): image
        for name, image in get_part(sample, "images", dict).items()
        if isinstance(image, dict) and all(image.get(key) is not None for key in NEEDED)
    }
    require(images, f"The images of {title} have no file or no pose; {ADVICE}.")
    time = get_number(sample, "timestamp", title, 0.0, MAX_TIME)
    time = time * 1e-6 if time >= MICROSECONDS else time
    world_from_laser = _read_laser_pose(sample, title)
    things = get_part(sample, "instances", list)
    things = [t for t in things if isinstance(t, dict) and "velocity" in t]  # none in Waymo's infos
    boxes = partial(_read_boxes, things, world_from_laser, path) if things else None
    frames = {
        name: replace(_make_frame(path, name, time, image, world_from_laser), boxes=boxes)
        for name, image in images.items()
    }
    first = os.path.basename(frames.get(FRONT, next(iter(frames.values()))).name)
    drive = get_text(sample, "context_name", title) or first.split("__")[0]
    return _Sample(drive, time, frames)


def _read_laser_pose(sample: Any, title: str) -> Pose:
    vehicle = get_array(sample, "ego2global", title, (4, 4))
    lidar = get_part(sample, "lidar_points", dict)
    if "lidar2ego" not in lidar:  # in Waymo's infos the laser frame is that of the vehicle
        return vehicle
    return vehicle @ get_array(lidar, "lidar2ego", title, (4, 4))


def _split_scenes(samples: list[_Sample]) -> Iterator[list[_Sample]]:
    """Group consecutive samples of one drive."""
    scene = samples[:1]
    for before, after in pairwise(samples):
        if after.drive != before.drive or after.time - before.time > MAX_GAP:
            yield scene
            scene = []
        scene.append(after)
    yield scene


def _build_scene(path: Path, samples: list[_Sample]) -> Photographs:
    cameras = {camera for sample in samples for camera in sample.frames}
    names = sorted(cameras, key=lambda name: (name != FRONT, name))
    frames = [s.frames[name] for name in names for s in samples if name in s.frames]
    called = f"{samples[0].drive}_{samples[0].time:.3f}"
    return build_drive(called, str(path), frames, front=names[0])


def _make_frame(path: Path, camera: str, time: float, image: Any, world_from_laser: Pose) -> Frame:
    title = f"the photograph of {camera} at {time:.3f} in {quote_value(path)}"
    file = get_text(image, "img_path", title) or ""
    camera_from_laser = get_array(image, "lidar2cam", title, (4, 4))
    c2w = np.full((4, 4), np.nan)  # stays where the pose is singular, which is a defect of it
    with np.errstate(all="ignore"), suppress(np.linalg.LinAlgError):
        # Through the laser frame: lidar2cam includes the vehicle's motion between the
        # times of laser and camera.
        c2w = world_from_laser @ np.linalg.inv(camera_from_laser)
    K = get_array(image, "cam2img", title, (3, 3), (3, 4))
    size = get_size(image, title) if "width" in image and "height" in image else None
    intrinsics = Intrinsics(size, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]))
    name, place = f"{camera}/{os.path.basename(file)}", _find_image(path.parent, file, camera)
    return Frame(name, title, c2w, intrinsics, place, sensor=camera)


def _find_image(folder: Path, file: str, camera: str) -> Path:
    """Find an image beside the pickle, or in the data set's folder of its camera."""
    order = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_SIDE_LEFT", "CAM_SIDE_RIGHT")
    numbered = f"image_{order.index(camera)}" if camera in order else camera
    places = [folder / file, folder / "samples" / camera / file, folder / camera / file]
    places += [folder / part / numbered / file for part in ("training", "validation", "testing")]
    return next((place for place in places if os.path.isfile(place)), places[0])


def _read_boxes(things: list[Any], world_from_laser: Pose, path: Path) -> tuple[Box, ...]:
    """Read the boxes of a sample; in the infos they are in the laser frame."""
    title, boxes = f"a box in {quote_value(path)}", []
    for thing in things:
        center, sides, (heading,) = np.split(get_array(thing, "bbox_3d", title, (7,)), [3, 6])
        velocity = get_array(thing, "velocity", title, (2,))
        boxes.append(build_box(world_from_laser, center, sides, heading, velocity))
    return tuple(boxes)
