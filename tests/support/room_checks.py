"""Checks that a scene on the disk is the room of `pose_files`."""

from pathlib import Path

import numpy as np
import torch

from gscompleter.data.photographs import Photographs
from gscompleter.types import Camera
from pose_files import CAMERAS
from scenes import Room, view_of


def check(camera: Camera, truth: Camera) -> None:
    assert torch.allclose(camera.c2w, truth.c2w, atol=2e-6)
    assert torch.allclose(camera.K, truth.K, atol=1e-3)
    assert (camera.width, camera.height) == (truth.width, truth.height)


def check_room(photographs: Photographs, numbers: list[int] | None = None) -> None:
    """Check that the photographs show the room from their cameras."""
    numbers = list(range(len(CAMERAS))) if numbers is None else numbers
    assert len(photographs) == len(numbers)
    for view, number in zip(photographs.views(range(len(numbers))), numbers, strict=True):
        check(view.camera, CAMERAS[number])
        seen = view_of(Room(), view.camera).image
        assert (view.image - seen).abs().mean() < 0.003
        # The room differs from any other place.
        other = view_of(Room(), CAMERAS[number - 1]).image
        assert (view.image - other).abs().mean() > 0.01


def write_cloud(path: Path, points: np.ndarray) -> None:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "property uchar red\n"
    rows = "\n".join(" ".join([*map(repr, point), "7"]) for point in points.tolist())
    path.write_text(f"{header}end_header\n{rows}\n")
