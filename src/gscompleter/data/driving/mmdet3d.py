"""Infos in the format 1.1 of mmdetection3d, for nuScenes and for Waymo in KITTI's layout.

A pickle lists samples: the pose of the vehicle, and image, intrinsics and pose of each camera.
Consecutive samples of one drive make a scene. Lengths are in metres, and camera axes those of
OpenCV. Frames are the vehicle (`ego`), its laser (`lidar`) and the map (`global`); `a2b` is the
matrix that maps points of a to b.
"""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.driving.vehicle import compute_moving_boxes
from gscompleter.data.frame import Frame
from gscompleter.data.json_fields import get_array, get_number, get_part, get_size, get_text
from gscompleter.data.limits import require
from gscompleter.data.photographs import Photographs, build_drive
from gscompleter.system.damage import DamagedError, describe_damage
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import check_plain, read_bytes

INFOS_ADVICE = "write the infos again with mmdetection3d 1.4"
FRONT_CAMERA_KEY = "CAM_FRONT"
NEEDED = ("img_path", "cam2img", "lidar2cam")
"""Entries of an image that has a file and a pose."""
MAX_GAP = 1.5
"""Largest gap between samples of a scene, in seconds; nuScenes has 0.5."""
MICROSECONDS = 1e12
"""Times from here on are in microseconds; in seconds they would be after the year 33000."""
MAX_PICKLE_BYTES = 1 << 30
"""Largest pickle in bytes."""
MAX_REPEATS = 4
"""Most values per byte of a pickle: an object that refers to itself many times stands for more."""
CONSTRUCTORS: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy.core.multiarray", "scalar"): np.float64().__reduce__()[0],
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): str.encode,
}
"""Functions that a pickle may name, which make NumPy scalars, by module and name."""

Pose = Float[np.ndarray, "4 4"]
Shot = tuple[str, float, Frame]
"""Drive, time in seconds, and photograph."""


def has_infos(path: Path) -> bool:
    """Check whether `path` is a pickle, by its ending."""
    return path.suffix == ".pkl" and os.path.isfile(path)


def open_infos(path: Path) -> Iterator[Photographs]:
    """Open the scenes of a pickle, named by drive and start time.

    Frames are numbered camera by camera, the front camera first, and by time. Images are searched
    beside the pickle and below it. Raises InputError if the pickle holds no infos of this format.
    """
    content = get_part(load_plain(path), "data_list", list)
    require(content, f"{quote_value(path)} holds no infos with a `data_list`; {INFOS_ADVICE}.")
    shots = [shot for sample in content for shot in _parse_sample(sample, path)]
    shots.sort(key=lambda shot: shot[:2])
    return (_build_scene(path, scene) for scene in _split_scenes(shots))


def _parse_sample(sample: Any, path: Path) -> list[Shot]:
    """Parse the photographs of one time, those without a file or a pose left out."""
    title = f"a sample of {quote_value(path)}"
    # Names of cameras are shown to the user, and make names of photographs.
    images = {
        quote_value(name): image
        for name, image in get_part(sample, "images", dict).items()
        if isinstance(image, dict) and all(image.get(key) is not None for key in NEEDED)
    }
    require(images, f"The images of {title} have no file or no pose; {INFOS_ADVICE}.")
    # Infos of nuScenes are in seconds, those of Waymo in microseconds.
    time = get_number(sample, "timestamp", title, 0.0, 1e6 * MICROSECONDS)
    time = time * 1e-6 if time >= MICROSECONDS else time

    # In Waymo's infos the laser frame is that of the vehicle.
    lidar = {"lidar2ego": np.eye(4), **get_part(sample, "lidar_points", dict)}
    world_from_vehicle = get_array(sample, "ego2global", title, (4, 4))
    world_from_laser = world_from_vehicle @ get_array(lidar, "lidar2ego", title, (4, 4))
    things = get_part(sample, "instances", list)
    things = [t for t in things if isinstance(t, dict) and "velocity" in t]  # none in Waymo's infos
    boxes = partial(_read_infos_boxes, things, world_from_laser, path) if things else None

    # Waymo's infos name the drive. nuScenes begins its file names with it, as in
    # "n015-2018-07-24-11-22-45+0800__CAM_FRONT__…". Without either, times alone tell drives apart.
    first = images.get(FRONT_CAMERA_KEY, next(iter(images.values())))
    start, mark, _ = os.path.basename(get_text(first, "img_path", title) or "").partition("__")
    drive = get_text(sample, "context_name", title) or (start if mark else path.stem)
    frames = (
        _make_infos_frame(path, n, time, image, world_from_laser) for n, image in images.items()
    )
    return [(drive, time, replace(frame, boxes=boxes)) for frame in frames]


def _split_scenes(shots: list[Shot]) -> Iterator[list[Shot]]:
    """Group consecutive photographs of one drive; `shots` are sorted by drive and time."""
    scene = shots[:1]
    for (drive, time, _), after in pairwise(shots):
        if after[0] != drive or after[1] - time > MAX_GAP:
            yield scene
            scene = []
        scene.append(after)
    yield scene


def _build_scene(path: Path, shots: list[Shot]) -> Photographs:
    """Build a scene of photographs that are sorted by time."""
    (drive, time, _), *_ = shots
    frames = [frame for _, _, frame in shots]
    # A stable sort: within a camera they stay in the order of time.
    frames.sort(key=lambda frame: (frame.sensor != FRONT_CAMERA_KEY, frame.sensor))
    return build_drive(f"{drive}_{time:.3f}", quote_value(path), frames, front=frames[0].sensor)


def _make_infos_frame(
    path: Path, camera: str, time: float, image: Any, world_from_laser: Pose
) -> Frame:
    """Make the frame of one camera at one time."""
    title = f"the photograph of {camera} at {time:.3f} in {quote_value(path)}"
    file = get_text(image, "img_path", title) or ""
    camera_from_laser = get_array(image, "lidar2cam", title, (4, 4))
    c2w = np.full((4, 4), np.nan)  # stays where the pose is singular, which is a defect of it
    with np.errstate(all="ignore"), suppress(np.linalg.LinAlgError):
        # Through the laser frame: lidar2cam includes the vehicle's motion between the
        # times of laser and camera.
        c2w = world_from_laser @ np.linalg.inv(camera_from_laser)
    K = get_array(image, "cam2img", title, (3, 3), (3, 4), (4, 4))
    # Infos of Waymo before mmdetection3d 1.4, whose matrices are 4 × 4, give its camera 2, which
    # looks to the front left, the name CAM_FRONT_RIGHT, and so on. Their images would be searched
    # in each other's folders.
    require(
        K.shape != (4, 4),
        f"The `cam2img` of {title} is 4 × 4, as in infos of Waymo before mmdetection3d 1.4, which "
        f"take left cameras for right ones; {INFOS_ADVICE}.",
    )
    size = get_size(image, title) if "width" in image and "height" in image else None
    intrinsics = Intrinsics(size, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]))
    name = f"{camera}/{os.path.basename(file)}"
    place = _find_image(path.parent, file, camera)
    return Frame(name, title, c2w, intrinsics, place, sensor=camera)


def _find_image(folder: Path, file: str, camera: str) -> Path:
    """Find an image beside the pickle, or in the data set's folder of its camera.

    Those folders are `samples/CAMERA` of nuScenes, and of Waymo `training/image_0` and the like,
    which are numbered in the order of Waymo's cameras. Without an image, the path beside the pickle
    is returned.
    """
    order = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_SIDE_LEFT", "CAM_SIDE_RIGHT")
    numbered = f"image_{order.index(camera)}" if camera in order else camera
    places = [folder / file, folder / "samples" / camera / file, folder / camera / file]
    places += [folder / part / numbered / file for part in ("training", "validation", "testing")]
    return next((place for place in places if os.path.isfile(place)), places[0])


def _read_infos_boxes(
    things: list[Any], world_from_laser: Pose, path: Path
) -> Float[np.ndarray, "n 8 3"]:
    """Read the corners of moving boxes in the world frame, from `things` in the laser frame.

    A box is its centre, length, width and height in metres, and its yaw in radians. NaN as a
    velocity, in metres per second, means that it is unknown.
    """
    title = f"a box in {quote_value(path)}"
    parts = (("bbox_3d", (7,)), ("velocity", (2,)))
    rows = [[get_array(thing, key, title, shape) for key, shape in parts] for thing in things]
    return compute_moving_boxes(world_from_laser, np.stack([np.concatenate(row) for row in rows]))


# Python's own unpickler: that in C allocates whatever size a few bytes claim.
class _PlainUnpickler(pickle._Unpickler):
    """Unpickler of plain values and NumPy scalars, which calls nothing else that a file names."""

    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        # `numpy._core` is the name of the module since NumPy 2.
        constructor = CONSTRUCTORS.get((module.replace("numpy._core", "numpy.core"), name))
        if constructor is None:
            raise DamagedError(f"it names {module}.{name}")
        return constructor


def load_plain(path: Path) -> Any:
    """Load the plain value in a pickle; raise InputError for anything else, or one without end."""
    data = read_bytes(path, MAX_PICKLE_BYTES)
    try:
        value = _PlainUnpickler(io.BytesIO(data)).load()
    except Exception as error:  # damaged pickles raise anything
        raise InputError(
            f"{quote_value(path)} is no pickle of plain values ("
            f"{quote_value(describe_damage(error))}); write it again with lists and numbers only."
        ) from error
    check_plain(value, path, MAX_REPEATS * len(data))
    return value
