"""What the tests of the viewer look at: a room before and after, and its cameras."""

from __future__ import annotations

from dataclasses import replace

import torch

from gscompleter.types import Camera, Gaussians, merge
from gscompleter.viewer.exhibit import Exhibit, Shot
from scenes import Room, camera_at, gaussians_of, view_of

SIDE = 64
"""Pixels of a side of the cameras' images, few enough for a browser that draws in software."""
LEFT = camera_at(x=-0.3, yaw=-7, size=SIDE)
"""Where the room is observed from."""


def off_centre(camera: Camera) -> Camera:
    """The same camera with a principal point that is not in the middle of the image."""
    K = camera.K.clone()
    K[0, 2] += 6
    K[1, 2] -= 3
    return replace(camera, K=K)


TARGET = off_centre(camera_at(x=0.8, z=0.5, yaw=20, size=SIDE))
"""Where it has a hole: to the right of what is observed."""


def room_from(camera: Camera, generated: int, unit: float = 1.0) -> Gaussians:
    """What a camera sees of the room, marked as generated for a target (0: as observed)."""
    gaussians = gaussians_of(view_of(Room(unit=unit), camera))
    return replace(gaussians, generated=torch.full_like(gaussians.generated, generated))


def room_exhibit(title: str = "room") -> Exhibit:
    """The room as the left camera sees it, and with what the target camera sees besides."""
    before = room_from(LEFT, 0)
    after = merge([before, room_from(TARGET, 1)])
    shots = (Shot("target-1", "Target 1", TARGET), Shot("camera-1", "Left", LEFT))
    return Exhibit(title, after, before, shots)
