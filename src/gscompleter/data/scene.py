"""Views and cameras of one scene, and writing of nerfstudio's `transforms.json`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gscompleter.data.camera_files import read_cameras
from gscompleter.data.formats import open_photographs
from gscompleter.data.limits import check_planes, require
from gscompleter.data.mask_checks import read_masks_as_asked, refuse_nothing_to_invert
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.data.transforms import OPENCV_FROM_OPENGL, parse_camera_frame
from gscompleter.system.errors import quote_value, require_path
from gscompleter.system.files.result_format import RESULT_MARK
from gscompleter.system.files.writing import replace_file
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import Camera, View

CAMERA_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "transform_matrix")
"""Keys by which `describe_camera` describes a camera."""


@run_in_plain_torch
def load_views(
    scene: Path | str,
    frames: Sequence[int | str] | None = None,
    resolution: Resolution = None,
    near: float | None = None,
    far: float | None = None,
    invert_masks: bool = False,
    large_masks: bool = False,
    origin: Sequence[float] | None = None,
) -> list[View]:
    """Load the photographs of a scene with their cameras, and true depth if available.

    Lens distortion is removed. If coordinates are so large that float32 would lose the baselines,
    cameras are relative to `open_photographs(scene).origin`; with a splat in the same map, give
    its `origin`.
    Black pixels of masks and transparent ones are ignored; with `invert_masks` white ones of masks.
    Masks that hide more than half of most photographs may be the other way round and raise an
    InputError; `large_masks` takes them as they are.
    `frames` are numbers, counted by sorted names, or names of photographs as on the command line;
    all that have a camera if None. `resolution` is height and width in pixels,
    or the most pixels of the longer side; `near` and `far` are z-depths in scene units, if known.
    """
    reading = MaskReading(invert_masks, large_masks)
    photographs = shift_photographs(open_photographs(scene, near=near, far=far), origin)
    refuse_nothing_to_invert(photographs.list_masks(), reading)
    photographs = read_masks_as_asked(photographs, reading)
    chosen = photographs.posed if frames is None else frames
    require(
        isinstance(chosen, (Sequence, np.ndarray)) and not isinstance(chosen, (str, bytes)),
        f"The frames have to be a list of numbers or names of photographs, and are "
        f"'{quote_value(chosen)}'.",
    )
    return photographs.views(chosen, resolution)


@run_in_plain_torch
def load_camera(
    scene: Path | str,
    frame: int | str | None = None,
    resolution: Resolution = None,
    near: float | None = None,
    far: float | None = None,
    origin: Sequence[float] | None = None,
) -> Camera:
    """Load the camera of a frame, with or without photograph; None takes the only frame.

    `frame` is its number, or the name of its photograph. `origin` is as in `load_views`.
    """
    photographs = shift_photographs(open_photographs(scene, near=near, far=far), origin)
    require(
        frame is not None or len(photographs) == 1,
        f"{photographs.title} has {len(photographs)} frames; choose one, from 0 to "
        f"{len(photographs) - 1}.",
    )
    return photographs.camera(0 if frame is None else frame, resolution)


def shift_photographs(photographs: Photographs, origin: Sequence[float] | None) -> Photographs:
    """Return photographs relative to an origin, or to their own if it is None."""
    if origin is None:
        return photographs
    place = np.asarray(origin, dtype=np.float64)
    require(
        place.shape == (3,) and bool(np.isfinite(place).all()),
        f"An origin has three numbers, and is '{quote_value(origin)}'.",
    )
    return replace(photographs, origin=place)


@run_in_plain_torch
def load_cameras(
    path: Path | str,
    resolution: Resolution = None,
    near: float | None = None,
    far: float | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> list[Camera]:
    """Load all cameras of a file in its order, without photographs.

    `path` is a JSON file in the layout of nerfstudio's `transforms.json` or `camera_path.json`,
    Inria's `cameras.json` or SuperSplat's poses, which need a height and width; a folder with a
    `transforms.json` or a COLMAP model; or the images.txt or images.bin of such a model. `origin`
    is that of the scene's coordinates, `open_photographs(scene).origin`; the rest is as in
    `load_views`.
    """
    check_planes(near, far)
    path = require_path(path)
    frames = tuple(read_cameras(path, resolution))
    zero = np.asarray(origin, dtype=np.float64)
    cameras = Photographs(path.stem, quote_value(path), frames, zero, near, far)
    return [cameras.camera(number, resolution) for number in range(len(cameras))]


def parse_camera(
    described: Mapping[str, Any],
    title: str,
    resolution: Resolution = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> Camera:
    """Read what `describe_camera` writes, as `load_cameras` does from a file, and nothing else.

    It may come from anybody: keys of a `transforms.json` that name files raise InputError. `title`,
    such as "the camera", is for sentences.
    """
    for key in described:
        require(
            key in CAMERA_KEYS, f"The `{quote_value(key)}` of {title} is unknown; leave it out."
        )
    frame = parse_camera_frame(described, title)
    zero = np.asarray(origin, dtype=np.float64)
    return Photographs(title, title, (frame,), zero, None, None).camera(0, resolution)


def write_cameras(
    path: Path | str, cameras: Sequence[Camera], file_paths: Sequence[str] | None = None
) -> None:
    """Write cameras to a JSON file that `load_cameras` reads back bit for bit.

    Near and far planes are not part of the format. `file_paths` are image paths relative to its
    folder, for the `transforms.json` of a scene.
    """
    frames = [describe_camera(camera) for camera in cameras]
    if file_paths is not None:
        pairs = zip(file_paths, frames, strict=True)
        frames = [{"file_path": file_path, **frame} for file_path, frame in pairs]
    content = {**RESULT_MARK, "camera_model": "PINHOLE", "frames": frames}
    with replace_file(path) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def describe_camera(camera: Camera) -> dict[str, object]:
    """Describe a camera by the keys of a frame in `transforms.json`, in OpenGL axes."""
    (fl_x, _, cx), (_, fl_y, cy), _ = camera.K.double().tolist()
    # float64 holds a float32 exactly, and JSON writes as many digits as restore it.
    c2w = camera.c2w.detach().cpu().double().numpy() @ OPENCV_FROM_OPENGL
    return {
        "fl_x": fl_x,
        "fl_y": fl_y,
        "cx": cx,
        "cy": cy,
        "w": camera.width,
        "h": camera.height,
        "transform_matrix": c2w.tolist(),
    }
