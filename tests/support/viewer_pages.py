"""Scenes for the tests of the viewer: a room before and after, and its cameras."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import torch

from gscompleter.apps.viewer.exhibit import ViewerCamera, ViewerContent
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.types import Camera, Gaussians, merge
from scenes import Room, camera_at, gaussians_of, view_of

NONE = Libraries({}, {})
"""A page without libraries renders nothing, which only a browser would notice."""
SIDE = 64
"""Image size of the cameras in pixels, small enough for software rendering."""
LEFT = camera_at(x=-0.3, yaw=-7, size=SIDE)
"""Camera that observes the room."""


def content_of(page: bytes) -> dict:
    """Read the content that the page has for its program."""
    found = re.findall(
        r'<script type="application/json" id="content">(.*?)</script>', page.decode(), re.S
    )
    return json.loads(found[0])


def off_centre(camera: Camera) -> Camera:
    """Shift the principal point of a camera away from the centre of the image."""
    K = camera.K.clone()
    K[0, 2] += 6
    K[1, 2] -= 3
    return replace(camera, K=K)


TARGET = off_centre(camera_at(x=0.8, z=0.5, yaw=20, size=SIDE))
"""Camera that sees a hole, to the right of the observed part."""


def room_from(camera: Camera, generated: int, unit: float = 1.0) -> Gaussians:
    """Make the part of the room that a camera sees, with the label `generated`."""
    gaussians = gaussians_of(view_of(Room(unit=unit), camera))
    return replace(gaussians, generated=torch.full_like(gaussians.generated, generated))


def room_exhibit(title: str = "room") -> ViewerContent:
    """Make the room as the left camera sees it, and completed for the target camera."""
    before = room_from(LEFT, 0)
    after = merge([before, room_from(TARGET, 1)])
    shots = (ViewerCamera("target-1", "Target 1", TARGET), ViewerCamera("camera-1", "Left", LEFT))
    return ViewerContent(title, after, before, shots)
