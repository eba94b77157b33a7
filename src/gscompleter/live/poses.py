"""Cameras as the page has them, and as the library does.

Both have OpenCV axes. The page has a unit of its own, in which what the photographs see is a few
units away, since its controls and clipping planes expect that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.geometry import quats_from, rotations_from
from gscompleter.types import Camera

DISTANCE = 3.0
"""How far away, in units of the page, the middle of the depth range is."""


@dataclass(frozen=True)
class Pose:
    """Where a camera of the page stands, and how much it sees."""

    wxyz: Float[np.ndarray, "4"]
    """Its rotation to the world, as a quaternion."""
    position: Float[np.ndarray, "3"]
    """Its centre, in units of the page."""
    fov: float
    """Angle between the upper and the lower border of its image, in radians."""


def unit_of(camera: Camera) -> float:
    """Units of the page in a unit of the scene; `camera` has the depth range of the scene."""
    assert camera.near is not None
    assert camera.far is not None
    return DISTANCE / math.sqrt(camera.near * camera.far)


def pose_of(camera: Camera, unit: float) -> Pose:
    """A camera of the scene as the page has it."""
    c2w = camera.c2w.detach().cpu().double()
    fov = 2 * math.atan(camera.height / 2 / camera.K[1, 1].item())
    return Pose(quats_from(c2w[:3, :3]).numpy(), c2w[:3, 3].numpy() * unit, fov)


def camera_of(pose: Pose, height: int, width: int, unit: float) -> Camera:
    """A camera of the page as the scene has it: an image of `height` x `width` pixels that shows
    all that the page shows between its upper and its lower border."""
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3] = rotations_from(torch.from_numpy(np.asarray(pose.wxyz, dtype=np.float64)))
    c2w[:3, 3] = torch.from_numpy(np.asarray(pose.position, dtype=np.float64)) / unit
    focal = height / 2 / math.tan(pose.fov / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(c2w.float(), K, width, height)
