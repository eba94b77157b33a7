"""Two photographs of a room in which an object moved between them."""

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.geometry import unproject
from gscompleter.types import Camera, View
from scenes import Room, camera_at, cast, texture

SIZE = 96

OUTSIDE = Room().boxes[0]

IN_FRONT = ((-0.3, -0.3, 1.8), (0.3, 1.5, 2.1))

ROOM = Room(boxes=(OUTSIDE, IN_FRONT))

CAMERAS = (camera_at(0, 0, size=SIZE), camera_at(0, -0.3, size=SIZE))

PLACES = (-0.55, 0.9)
"""x of a red object in the first photograph, half hidden, and in the second."""


def with_something_red(camera: Camera, x: float) -> tuple[View, Bool[Tensor, "h w"]]:
    """Take a photograph with a red, textured box at `x`, and its mask; the depth is of the room."""
    box = ((x - 0.3, 0.1, 2.6), (x + 0.3, 0.9, 3.0))
    image, depth = cast(ROOM, camera)
    _, nearest = cast(Room(boxes=(*ROOM.boxes, box)), camera)
    red = nearest < depth - 1e-3
    points = unproject(nearest, camera) - torch.tensor([x, 0.0, 0.0])
    colour = texture(points) * torch.tensor([1.0, 0.15, 0.15]) + torch.tensor([0.2, 0.0, 0.0])
    shown = torch.where(red[..., None], colour.clamp(0, 1), image)
    return View(shown, camera, depth=depth), red


def photographed() -> tuple[list[View], list[Bool[Tensor, "h w"]]]:
    views, reds = zip(*map(with_something_red, CAMERAS, PLACES), strict=True)
    return list(views), list(reds)
