"""Infos of mmdetection3d 1.1, for nuScenes and for Waymo in KITTI's layout.

A pickle lists samples: the vehicle pose, and image, intrinsics and pose of each camera. Consecutive
samples of one drive make a scene.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.driving.moving_objects import Box, build_upright_pose, convert_speed
from gscompleter.data.driving.restricted_pickle import load_plain
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import (
    get_array,
    get_list,
    get_number,
    get_object,
    get_optional_number,
    get_text,
)
from gscompleter.data.limits import MAX_IN_PIXELS, MAX_SIDE
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import open_file

ADVICE = "write the infos again with mmdetection3d 1.1"
FRONT = "CAM_FRONT"
MAX_GAP = 1.5
"""Largest gap between samples of a scene, in seconds; nuScenes has 0.5."""
MAX_NUMBER = 1e12
MAX_TIME = 1e12
"""Largest time in seconds."""
MICROSECONDS = 1e12
"""Smallest time that is in microseconds."""
STATIC_CLASSES = frozenset(("traffic_cone", "barrier"))
"""Classes that do not move by themselves."""
MAX_SNIFFED = 4096
"""Bytes at either end of a pickle to detect infos."""


def has_infos(path: Path) -> bool:
    """Check whether `path` is a pickle of infos."""
    if path.suffix != ".pkl" or not os.path.isfile(path):
        return False
    with suppress(InputError), open_file(path) as file:
        head = file.read(MAX_SNIFFED)
        file.seek(max(os.path.getsize(path) - MAX_SNIFFED, 0))
        return b"data_list" in head + file.read() or b"metainfo" in head
    return False


def open_infos(path: Path) -> Iterator[Photographs]:
    """Open the scenes of a pickle, named by drive and start time.

    Frames are numbered camera by camera, the front camera first, and by time. Images are searched
    beside the pickle and below it.
    """
    content = load_plain(path)
    samples = get_list(content, "data_list")
    if not samples:
        raise InputError(f"{quote_value(path)} holds no infos with a `data_list`; {ADVICE}.")
    classes = get_object(content.get("metainfo"), "categories").items()
    kinds = {n: kind for kind, n in classes if isinstance(n, int) and isinstance(kind, str)}
    ordered = sorted((_parse_sample(s, path) for s in samples), key=lambda s: (s.drive, s.time))
    return (_build_scene(path, scene, kinds) for scene in _split_scenes(ordered))


@dataclass(frozen=True)
class _Sample:
    """Record of the vehicle at one time."""

    drive: str
    time: float
    """Time in seconds."""
    title: str
    content: dict[str, Any]
    images: dict[str, dict[str, Any]]
    """Images by camera."""

    @property
    def world_from_laser(self) -> Float[np.ndarray, "4 4"]:
        vehicle = _get_numbers(self.content, "ego2global", (4, 4), self.title)
        lidar = get_object(self.content, "lidar_points")
        if "lidar2ego" not in lidar:  # in Waymo's infos the laser frame is that of the vehicle
            return vehicle
        return vehicle @ _get_numbers(lidar, "lidar2ego", (4, 4), self.title)


def _parse_sample(sample: Any, path: Path) -> _Sample:
    title = f"a sample of {quote_value(path)}"
    images = sample.get("images") if isinstance(sample, dict) else None
    if not isinstance(images, dict):
        raise InputError(f"An entry of {quote_value(path)} has no `images`; {ADVICE}.")
    needed = ("img_path", "cam2img", "lidar2cam")
    posed = {
        quote_value(name): image
        for name, image in images.items()
        if isinstance(name, str)
        and all(get_object(images, name).get(n) is not None for n in needed)
    }
    if not posed:
        raise InputError(f"The images of {title} have no file or no pose; {ADVICE}.")
    time = get_number(sample, "timestamp", title, 0.0, MAX_TIME * 1e6)
    first = posed.get(FRONT) or next(iter(posed.values()))
    file = os.path.basename(get_text(first, "img_path", title) or "")
    drive = get_text(sample, "context_name", title) or file.split("__")[0]
    return _Sample(drive, time * 1e-6 if time >= MICROSECONDS else time, title, sample, posed)


def _split_scenes(samples: list[_Sample]) -> Iterator[list[_Sample]]:
    """Group consecutive samples of one drive."""
    scene = samples[:1]
    for before, after in pairwise(samples):
        if after.drive != before.drive or after.time - before.time > MAX_GAP:
            yield scene
            scene = []
        scene.append(after)
    yield scene


def _build_scene(path: Path, samples: list[_Sample], kinds: Mapping[int, str]) -> Photographs:
    cameras = {name for sample in samples for name in sample.images}
    names = sorted(cameras, key=lambda name: (name != FRONT, name))
    frames = [
        _make_frame(path, s, name, kinds) for name in names for s in samples if name in s.images
    ]
    called = f"{samples[0].drive}_{samples[0].time:.3f}"
    return build_drive(called, str(path), frames, front=names[0])


def _make_frame(path: Path, sample: _Sample, camera: str, kinds: Mapping[int, str]) -> Frame:
    image = sample.images[camera]
    title = f"the photograph of {camera} at {sample.time:.3f} in {quote_value(path)}"
    file = get_text(image, "img_path", title)
    assert file is not None
    camera_from_laser = _get_numbers(image, "lidar2cam", (4, 4), title)
    c2w = np.full((4, 4), np.nan)  # stays where the pose is singular, which is a defect of it
    with np.errstate(over="ignore", invalid="ignore"), suppress(np.linalg.LinAlgError):
        # Through the laser frame: lidar2cam includes the vehicle's motion between the
        # times of laser and camera.
        c2w = sample.world_from_laser @ np.linalg.inv(camera_from_laser)
    things = [t for t in get_list(sample.content, "instances") if isinstance(t, dict)]
    has_speeds = any("velocity" in thing for thing in things)  # as in nuScenes
    return Frame(
        f"{camera}/{os.path.basename(file)}",
        title,
        c2w,
        _parse_intrinsics(image, title),
        _find_image(path.parent, file, camera),
        sensor=camera,
        boxes=partial(_read_boxes, path, sample, things, kinds) if has_speeds else None,
    )


def _parse_intrinsics(image: Mapping[str, Any], title: str) -> Intrinsics:
    rows = image["cam2img"]
    wide = isinstance(rows, list) and all(isinstance(row, list) and len(row) == 4 for row in rows)
    K = get_array(image, "cam2img", (3, 4) if wide else (3, 3), title)
    if not np.isfinite(K).all() or np.abs(K).max() > MAX_IN_PIXELS:
        raise InputError(f"The `cam2img` of {title} is impossible; {ADVICE}.")
    sides = [
        get_optional_number(image, key, title, 1.0, float(MAX_SIDE)) for key in ("width", "height")
    ]
    size = None if sides[0] is None or sides[1] is None else (int(sides[0]), int(sides[1]))
    return Intrinsics(size, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]))


def _get_numbers(
    entry: Mapping[str, Any], key: str, shape: tuple[int, ...], title: str
) -> Float[np.ndarray, "*n"]:
    """Read the nested list at `key`; checks magnitude, allows NaN."""
    array = get_array(entry, key, shape, title)
    if (np.abs(array) > MAX_NUMBER).any():
        raise InputError(f"The `{key}` of {title} holds numbers beyond {MAX_NUMBER:g}; {ADVICE}.")
    return array


def _find_image(folder: Path, file: str, camera: str) -> Path:
    """Find an image beside the pickle, or in the data set's folder of its camera."""
    order = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_SIDE_LEFT", "CAM_SIDE_RIGHT")
    numbered = f"image_{order.index(camera)}" if camera in order else camera
    places = [folder / file, folder / "samples" / camera / file, folder / camera / file]
    places += [folder / part / numbered / file for part in ("training", "validation", "testing")]
    return next((place for place in places if os.path.isfile(place)), places[0])


def _read_boxes(
    path: Path, sample: _Sample, things: Sequence[dict[str, Any]], kinds: Mapping[int, str]
) -> tuple[Box, ...]:
    """Read the boxes of objects that may move; in the infos they are in the laser frame."""
    title, world = f"a box in {quote_value(path)}", sample.world_from_laser
    labels = [thing.get("bbox_label_3d") for thing in things]
    classes = [kinds.get(label) if isinstance(label, int) else None for label in labels]
    pairs = zip(things, classes, strict=True)
    return tuple(_parse_box(t, world, title) for t, kind in pairs if kind not in STATIC_CLASSES)


def _parse_box(thing: Mapping[str, Any], world: Float[np.ndarray, "4 4"], title: str) -> Box:
    center, sides, heading = np.split(_get_numbers(thing, "bbox_3d", (7,), title), [3, 6])
    unknown = np.full(2, np.nan)
    velocity = _get_numbers(thing, "velocity", (2,), title) if "velocity" in thing else unknown
    length, width, height = sides.tolist()
    pose = world @ build_upright_pose(center, float(heading[0]))
    return Box(pose, (length, width, height), convert_speed(velocity))
