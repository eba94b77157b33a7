"""The stereo pair that scikit-image contains, as a scene that needs no download.

It is the Middlebury 2014 motorcycle pair, downsampled by four, with its calibration (Scharstein et
al., GCPR 2014).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from skimage.data import stereo_motorcycle

from gscompleter.data.scene import write_cameras
from gscompleter.system.errors import InputError, quote_value, require_path
from gscompleter.system.files.image import write_image
from gscompleter.types import Camera

FOCAL_PX = 994.978
PRINCIPAL_POINT_PX = (311.193, 254.877)
PRINCIPAL_POINT_DX_PX = 31.086
"""Offset of the right image's principal point, in pixels."""
BASELINE_M = 0.193001


def write_demo_scene(folder: Path | str) -> Path:
    """Write the pair as a scene with two targets beside it, and return its folder.

    The folder gets a `transforms.json` with both photographs, and a `targets.json`. Writing it
    again changes nothing. Raise InputError for a folder with other files.
    """
    folder = require_path(folder)
    others = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if not others <= {"images", "transforms.json", "targets.json"}:
        raise InputError(f"{quote_value(folder)} holds other files; name another folder.")
    write_motorcycle_scene(folder)
    return folder


def get_motorcycle_cameras(width: int, height: int) -> tuple[Camera, Camera]:
    """Return the left and right camera in metres; the left one is the world frame.

    The pair is rectified: both cameras have the same focal length and axes, and the right one only
    another principal point.
    """
    K = torch.diag(torch.tensor([FOCAL_PX, FOCAL_PX, 1.0]))
    K[:2, 2] = torch.tensor(PRINCIPAL_POINT_PX)
    left = Camera(torch.eye(4), K, width, height)
    K_right = K.clone()
    K_right[0, 2] += PRINCIPAL_POINT_DX_PX
    return left, replace(move_right(left, BASELINE_M), K=K_right)


def move_right(camera: Camera, x: float) -> Camera:
    """Move a camera by `x` metres to the right."""
    c2w = camera.c2w.clone()
    c2w[0, 3] += x
    return replace(camera, c2w=c2w)


def write_motorcycle_scene(folder: Path) -> None:
    """Write the pair as a scene folder with `targets.json`."""
    left_image, right_image, _ = stereo_motorcycle()
    height, width = left_image.shape[:2]
    left, right = get_motorcycle_cameras(width, height)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for name, image in (("left", left_image), ("right", right_image)):
        write_image(folder / "images" / f"{name}.png", torch.from_numpy(image / 255).float())
    write_cameras(
        folder / "transforms.json", [left, right], ["images/left.png", "images/right.png"]
    )

    # Two targets, each a baseline beyond one of the cameras: they look behind what both
    # photographs show in front.
    beyond = [move_right(left, -BASELINE_M), move_right(right, BASELINE_M)]
    write_cameras(folder / "targets.json", beyond)
