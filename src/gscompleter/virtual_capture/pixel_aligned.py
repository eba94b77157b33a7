"""The camera of a splat that was lifted from pixels, and small moves of it.

Its centre is found from the sizes of the Gaussians (`trust/lifted.py`), and its direction and field
of view from where they lie.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.numerics.geometry import look_along, move_camera
from gscompleter.types import Camera, Gaussians

INNER = 0.93
"""Share of the directions, along each axis of the image, that the camera shows."""
MAX_DIRECTIONS = 2**24
"""Most directions that tell the field of view; `torch.quantile` takes no more."""
SIDEWAYS_MOVES = (
    (0.08, 0.0, 0.0),
    (-0.08, 0.0, 0.0),
    (0.0, 0.05, 0.0),
    (0.0, -0.05, 0.0),
    (0.0, 0.0, 0.12),
    (0.05, 0.0, 0.1),
    (-0.05, 0.0, 0.1),
)
"""Moves of the camera that is found: right, down and forward, relative to the depth of its view."""


def aim_pixel_camera(
    scene: Gaussians, center: Float[Tensor, "3"], up: Float[Tensor, "3"], side: int
) -> Camera:
    """Aim the camera of a pixel-aligned splat, with a square image.

    `center` is that of `find_pixel_center`, `up` the upward direction, and `side` the width and
    height of the image, in pixels.
    """
    rays = normalize(scene.means - center, dim=1)
    forward = normalize(rays.mean(dim=0), dim=0)
    c2w = torch.eye(4).to(rays)
    c2w[:3, 3] = center
    # The field of view follows from the direction: any intrinsics do until then.
    posed = look_along(Camera(c2w, make_intrinsics(side, 1.0).to(rays), side, side), forward, up)

    # The field of view holds most directions: of several photographs it is that of all together.
    x, y, z = ((scene.means - center) @ posed.c2w[:3, :3]).unbind(1)
    ahead = z > 0
    half = max(find_inner_limit((axis / z)[ahead].abs()) for axis in (x, y))
    return Camera(posed.c2w, make_intrinsics(side, half).to(rays), side, side)


def find_inner_limit(slopes: Float[Tensor, "n"]) -> float:
    """Find the slope up to which `INNER` of the slopes lie."""
    spacing = math.ceil(len(slopes) / MAX_DIRECTIONS)
    return slopes[::spacing].quantile(INNER).item()


def move_beside(camera: Camera, depth: float) -> list[Camera]:
    """Return a camera and small moves of it, relative to a z-depth in scene units."""
    no_turn = torch.eye(3).to(camera.c2w)
    axes = camera.c2w[:3, :3].T
    shifts = [depth * torch.tensor(move).to(axes) @ axes for move in SIDEWAYS_MOVES]
    return [camera, *(move_camera(camera, no_turn, shift) for shift in shifts)]


def make_intrinsics(side: int, half: float) -> Float[Tensor, "3 3"]:
    """Make the intrinsics of a square image whose border is `half` aside at a depth of 1."""
    focal = side / 2 / half
    return torch.tensor([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
