"""Whether a splat is an object on nothing, around which nothing is missing.

The Gaussians decide, not cameras that were found: those are chosen for images that are full, and
stand so close to an object that it fills even a wide one (decision 080).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import project, sample
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, thin_gaussians
from gscompleter.render.outside import (
    Extent,
    OutsideView,
    look_from_outside,
    measure_extent,
    place_outside_camera,
)
from gscompleter.render.protocols import Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.types import Camera, Gaussians

OUTSIDE_SIDE = 64
"""Width and height of the images from outside, in pixels."""
MAX_SURROUNDED = 0.1
"""Largest share of the border of an image from outside that an object covers. It was 0.00 to 0.02
for objects, and 0.21 for a trained splat of a wall."""
GRID = 5
"""Points along each side of the extent, from which one looks outward."""
CONE = 60.0
"""Largest angle, in degrees, from the outward direction that such a look shows."""
LOOK_SIDE = 16
"""Width and height of a look, in pixels."""
MAX_BOUNDED = 0.48
"""Largest mean share of these looks that ends on an object. It was 0.00 to 0.46 for objects, and
0.50 to 0.87 for rooms and streets (decision 080)."""
MIN_SEEN_FROM_OUTSIDE = 0.05
"""Least share of the points that has to be seen from outside. Of a closed box nearly none is."""
MAX_FLATNESS = 0.3
"""Largest ratio of the shortest to the middle side of the extent of open ground."""
MIN_GROUND = 0.9
"""Least share of the extent that open ground covers, seen along the shortest side."""
MIN_AROUND_CAMERA = 0.75
"""Least mean share of all directions in which a room surrounds the cameras of the user."""
MAX_CAMERAS = 12
"""Most cameras of the user that are compared."""


def is_object(scene: Gaussians, renderer: Renderer, given: Sequence[Camera] = ()) -> bool:
    """Tell an object on nothing from a scene.

    An object has nothing around it, and is not what bounds the space beside it: who looks outward
    there sees nothing. In a room such looks end on walls. Ground that is seen all over, and a box
    that is closed on all sides, are scenes. `given` are cameras of the user, none that was found:
    if they stand between walls, it is a scene, too.
    """
    extent = measure_extent(scene)
    views = look_from_outside(scene, renderer, OUTSIDE_SIDE, extent)
    if max(view.border_share for view in views) > MAX_SURROUNDED:
        return False
    if is_ground(scene, extent, renderer):
        return False

    small = thin_gaussians(scene, MAX_PREVIEW_GAUSSIANS)
    points = list_points(extent)
    points = points[find_seen_from_outside(points, views)]
    if len(points) < MIN_SEEN_FROM_OUTSIDE * GRID**3:
        return False
    if measure_bounded(small, extent, points, renderer) > MAX_BOUNDED:
        return False
    chosen = given[:: max(1, len(given) // MAX_CAMERAS)]
    around = [measure_around(small, camera, extent, renderer) for camera in chosen]
    return not around or sum(around) / len(around) < MIN_AROUND_CAMERA


def list_points(extent: Extent) -> Float[Tensor, "n 3"]:
    """List the points of a grid in the extent, without its middle, where nothing is outward."""
    steps = (2 * torch.arange(GRID).to(extent.center) + 1) / GRID - 1
    grid = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), dim=-1).reshape(-1, 3)
    grid = grid[grid.norm(dim=1) > 1 / GRID]
    return extent.center + (grid * extent.half) @ extent.axes


def find_seen_from_outside(
    points: Float[Tensor, "n 3"], views: Sequence[OutsideView]
) -> Bool[Tensor, "n"]:
    """Find points that some view sees before the splat or beside it: others are inside of it."""
    seen = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for view in views:
        pixels, z = project(points, view.camera)
        surface = torch.stack([view.render.depth, view.render.alpha], dim=-1)
        depth, alpha = sample(surface, pixels).unbind(-1)
        seen |= (alpha < COVERED) | (z < depth)
    return seen


def measure_bounded(
    scene: Gaussians, extent: Extent, points: Float[Tensor, "n 3"], renderer: Renderer
) -> float:
    """Measure how much of the looks from points outward ends on the splat, on average.

    Outward is in an extent that is scaled to a cube, so that of a low room it is up and down, too.
    """
    half_angle = math.radians(CONE)
    near = 0.01 * extent.radius

    def look(point: Float[Tensor, "3"]) -> Float[Tensor, ""]:
        offset = extent.axes @ (point - extent.center)
        forward = normalize(offset / extent.half.clamp_min(1e-12) ** 2, dim=0) @ extent.axes
        camera = place_outside_camera(point, forward, math.tan(half_angle), LOOK_SIDE, near)
        covered = renderer.render(scene, camera).alpha >= COVERED
        weights = weigh_directions(camera, math.cos(half_angle))
        return (weights * covered).sum() / weights.sum()

    return torch.stack(list(get_view_map(scene.means)(look, points))).mean().item()


def weigh_directions(camera: Camera, min_cosine: float) -> Float[Tensor, "h w"]:
    """Weigh pixels by their solid angle, and those outside of a cone around the axis by 0."""
    x = (torch.arange(camera.width) + 0.5 - camera.width / 2).to(camera.K) / camera.K[0, 0]
    y = (torch.arange(camera.height) + 0.5 - camera.height / 2).to(camera.K) / camera.K[1, 1]
    cosine = (1 + x[None] ** 2 + y[:, None] ** 2).rsqrt()
    return (cosine**3).where(cosine >= min_cosine, 0.0)


def is_ground(scene: Gaussians, extent: Extent, renderer: Renderer) -> bool:
    """Tell open ground: it is flat, and seen along its shortest side it fills the extent."""
    shortest, middle, longest = extent.half
    if shortest > MAX_FLATNESS * middle:
        return False
    small = thin_gaussians(scene, MAX_PREVIEW_GAUSSIANS)
    axis = extent.axes[0]
    # From so far that lines of sight are nearly parallel.
    distance = 20 * extent.radius
    camera = place_outside_camera(
        extent.center - distance * axis,
        axis,
        (1.5 * longest / distance).item(),
        2 * OUTSIDE_SIDE,
        distance - 2 * extent.radius,
    )
    covered = renderer.render(small, camera).alpha >= COVERED
    # Points all over the extent, as the camera sees them.
    steps = torch.linspace(-1, 1, OUTSIDE_SIDE).to(extent.half)
    level = torch.zeros((OUTSIDE_SIDE, OUTSIDE_SIDE, 3)).to(extent.half)
    level[..., 1] = middle * steps
    level[..., 2] = longest * steps[:, None]
    pixels, _ = project(extent.center + level.reshape(-1, 3) @ extent.axes, camera)
    return sample(covered[..., None].float(), pixels).mean().item() >= MIN_GROUND


def measure_around(scene: Gaussians, camera: Camera, extent: Extent, renderer: Renderer) -> float:
    """Measure the share of all directions in which a splat surrounds a camera."""
    shares = []
    center = camera.center.to(scene.means)
    for axis in torch.eye(3).to(scene.means):
        for forward in (axis, -axis):
            face = place_outside_camera(center, forward, 1.0, LOOK_SIDE, 0.01 * extent.radius)
            covered = renderer.render(scene, face).alpha >= COVERED
            weights = weigh_directions(face, 0.0)
            shares.append((weights * covered).sum() / weights.sum())
    return torch.stack(shares).mean().item()
