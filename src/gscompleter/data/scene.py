"""Posed photographs and cameras, in nerfstudio's `transforms.json` layout."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from gscompleter.data.framing import check_resolution, covering, resize
from gscompleter.data.lens import Distortion, Pinhole, remap, undistorted, undistortion_map
from gscompleter.data.transforms import (
    OPENCV_FROM_OPENGL,
    Frame,
    SceneIndex,
    as_tensor,
    read_frames,
    read_index,
)
from gscompleter.errors import InputError
from gscompleter.io.files import replacing
from gscompleter.io.image import as_image, read_depth, read_pixels
from gscompleter.types import Camera, View

__all__ = [
    "SceneIndex",
    "load_camera",
    "load_cameras",
    "load_views",
    "read_index",
    "write_cameras",
]


def load_views(
    scene: Path | str,
    frames: Sequence[int] | None = None,
    resolution: tuple[int, int] | None = None,
    near: float | None = None,
    far: float | None = None,
) -> list[View]:
    """The photographs of a scene with their cameras, and with true depth where it is there.

    Lens distortion is removed: the undistorted image has the size of the photograph and no
    empty pixel, and the intrinsics follow (`lens.undistorted` says how).

    Args:
        scene: A folder with nerfstudio's `transforms.json`, or the path of that file.
        frames: Numbers of the frames, which are numbered in the order of their sorted
            `file_path`; all frames if left out. Only these are read.
        resolution: Height and width in pixels: images are resized to cover it, then their
            centre is cropped. Their own size if left out.
        near: Smallest z-depth of the scene, in scene units, where known.
        far: Largest z-depth of the scene, in scene units, where known.

    Raises:
        InputError: where the scene, one of the frames or an image is missing or impossible.
    """
    _check_arguments(resolution, near, far)
    index = read_index(scene)
    numbers = range(len(index)) if frames is None else frames
    chosen = [index.frame(number) for number in numbers]
    maps: dict[tuple[Pinhole, Distortion], Float[np.ndarray, "h w 2"]] = {}
    return [
        _load_view(frame, number, resolution, near, far, maps)
        for number, frame in zip(numbers, chosen, strict=True)
    ]


def load_camera(
    scene: Path | str,
    frame: int | None = None,
    resolution: tuple[int, int] | None = None,
    near: float | None = None,
    far: float | None = None,
) -> Camera:
    """The camera of one frame, as `load_views` has it.

    Its photograph need not exist where `w` and `h` say how large it is.

    Args:
        scene: A folder with a `transforms.json`, or the path of a JSON file of that form.
        frame: Number of the frame; may be left out where there is one only.
        resolution: Height and width in pixels, as in `load_views`.
        near: Smallest z-depth of the scene, in scene units, where known.
        far: Largest z-depth of the scene, in scene units, where known.

    Raises:
        InputError: where the scene or the frame is missing or impossible, and where there are
            several frames and none is chosen.
    """
    _check_arguments(resolution, near, far)
    index = read_index(scene)
    if frame is None and len(index) > 1:
        raise InputError(
            f"{index.path} has {len(index)} frames; choose one, from 0 to {len(index) - 1}."
        )
    return _camera(index.frame(frame or 0), resolution, near, far)


def load_cameras(
    path: Path | str,
    resolution: tuple[int, int] | None = None,
    near: float | None = None,
    far: float | None = None,
) -> list[Camera]:
    """All cameras of a JSON file of the form of `transforms.json`, in its order.

    No images are needed where `w` and `h` are given.

    Args:
        path: The JSON file, or a folder with a `transforms.json`.
        resolution: Height and width in pixels, as in `load_views`.
        near: Smallest z-depth of the scene, in scene units, where known.
        far: Largest z-depth of the scene, in scene units, where known.

    Raises:
        InputError: where the file or one of its cameras is missing or impossible.
    """
    _check_arguments(resolution, near, far)
    return [_camera(frame, resolution, near, far) for frame in read_frames(path)]


def write_cameras(
    path: Path | str, cameras: Sequence[Camera], file_paths: Sequence[str] | None = None
) -> None:
    """Write cameras as a JSON file that `load_cameras` reads back bit for bit.

    Near and far planes are not part of the format.

    Args:
        path: The JSON file.
        cameras: At least one camera.
        file_paths: Where the image of each one lies, relative to the folder of the JSON file,
            which makes it the `transforms.json` of a scene.

    Raises:
        InputError: where the file cannot be written.
    """
    frames = [_entry(camera) for camera in cameras]
    if file_paths is not None:
        frames = [
            {"file_path": file_path, **frame}
            for file_path, frame in zip(file_paths, frames, strict=True)
        ]
    content = {"camera_model": "PINHOLE", "frames": frames}
    with replacing(path) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def _entry(camera: Camera) -> dict[str, object]:
    K = camera.K.double()
    c2w = camera.c2w.detach().cpu().double().numpy() @ OPENCV_FROM_OPENGL
    return {
        "fl_x": K[0, 0].item(),
        "fl_y": K[1, 1].item(),
        "cx": K[0, 2].item(),
        "cy": K[1, 2].item(),
        "w": camera.width,
        "h": camera.height,
        "transform_matrix": c2w.tolist(),
    }


def _camera(
    frame: Frame, resolution: tuple[int, int] | None, near: float | None, far: float | None
) -> Camera:
    width, height = frame.size()
    pinhole = _undistorted(frame, frame.intrinsics.at(width, height))
    final = covering(width, height, resolution).camera(pinhole)
    return Camera(as_tensor(frame.c2w), final.K, final.width, final.height, near, far)


def _undistorted(frame: Frame, pinhole: Pinhole) -> Pinhole:
    new = undistorted(pinhole, frame.intrinsics.distortion)
    if new is None:
        raise InputError(
            f"The distortion coefficients of {frame.name} fold the image over itself; correct "
            "them, or undistort the images first."
        )
    return new


def _load_view(
    frame: Frame,
    number: int,
    resolution: tuple[int, int] | None,
    near: float | None,
    far: float | None,
    maps: dict[tuple[Pinhole, Distortion], Float[np.ndarray, "h w 2"]],
) -> View:
    """Read one frame; `maps` keeps the undistortion that frames of one lens share."""
    photograph = frame.photograph
    if photograph is None:
        raise InputError(
            f"The image of {frame.name} is missing; restore it, or choose another frame."
        )
    pixels = read_pixels(photograph)
    height, width = pixels.shape[:2]
    depth = None if frame.depth_path is None else read_depth(frame.depth_path, frame.depth_unit)
    if depth is not None:
        depth = resize(depth, (width, height), Image.Resampling.NEAREST)

    distortion = frame.intrinsics.distortion
    if distortion:
        lens = frame.intrinsics.at(width, height), distortion
        if lens not in maps:
            maps[lens] = undistortion_map(*lens, _undistorted(frame, lens[0]))
        pixels = remap(pixels, maps[lens], cv2.INTER_CUBIC)
        depth = None if depth is None else remap(depth, maps[lens], cv2.INTER_NEAREST)

    framing = covering(width, height, resolution)
    image = as_image(framing.image(pixels, Image.Resampling.LANCZOS))
    if depth is not None:
        depth = framing.image(depth, Image.Resampling.NEAREST)
    return View(
        image,
        _camera(frame, resolution, near, far),
        number,
        None if depth is None else torch.from_numpy(depth),
    )


def _check_arguments(
    resolution: tuple[int, int] | None, near: float | None, far: float | None
) -> None:
    check_resolution(resolution)
    for name, value in (("near", near), ("far", far)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(
                f"The {name} plane at {value} is impossible; give a positive z-depth in scene "
                "units."
            )
    if near is not None and far is not None and near >= far:
        raise InputError(f"The near plane at {near} is not before the far plane at {far}.")
