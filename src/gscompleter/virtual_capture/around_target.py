"""Search for cameras around a target, whose renders show what surrounds its hole.

The target itself is moved aside and turned, and of the cameras that come out those are chosen
greedily that are covered by the scene, see the border of the hole and have a baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import (
    add_near_plane,
    axis_angle_to_matrix,
    compute_field_of_view,
    is_inside,
    look_along,
    measure_baseline,
    move_camera,
    project,
    sample,
    shrink_camera,
    unproject,
)
from gscompleter.numerics.image_ops import dilate
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, thin_gaussians
from gscompleter.render.protocols import Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.types import Camera, Gaussians, Render

MAX_CHOSEN_CAMERAS = 3
"""Most cameras that are chosen around a target."""
COMPARED_SIDE = 72
"""Longer side, in pixels, of the images in which cameras are compared."""
MOVE_LENGTHS = (0.12, 0.3)
"""Lengths of moves, relative to the depth of the hole's border."""
TURN = 0.25
"""Turns in place, relative to the field of view."""
STEP_WITH_TURN = 0.15
"""Length of a move with such a turn, relative to the depth of the hole's border."""
DIRECTIONS = (
    (1.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.0, 0.0, -1.0),
    (1.0, 0.0, -1.0),
    (-1.0, 0.0, -1.0),
)
"""Directions of moves in the axes of the target: right, left, down, up, back, and back aside."""
BORDER_RADIUS = 0.12
"""Width of a hole's border, relative to the longer side of the image."""
NEAREST_TARGET_QUANTILE = 0.05
"""Quantile of the target's depths that counts as its nearest surface."""
SURFACE_CLEARANCE = 0.5
"""Depth below which a surface is too close, relative to that nearest surface."""
MAX_CLOSE = 0.02
"""Largest share of an image that surfaces that are too close may fill."""
OCCLUSION = 1.05
"""Depth of a point behind a rendered surface, relative to it, up to which it counts as seen."""
ENOUGH_BASELINE = 0.15
"""Baseline to the target, relative to the border's depth, from which a longer one gains nothing."""
ENOUGH_APART = 0.1
"""The same between two chosen cameras."""
KNOWN_WORTH = 0.25
"""Worth of a camera that shows no new part of the border; the new part it shows is added to it."""
MIN_CAMERA_GAIN = 1e-4
"""Gain below which no further camera is chosen."""


@dataclass(frozen=True)
class HoleBorder:
    """The surfaces around the hole of a target, in world coordinates."""

    points: Float[Tensor, "n 3"]
    """Points beside the hole."""
    all_points: Float[Tensor, "m 3"]
    """All points that the target sees."""
    depth: float
    """Median z-depth of the points beside the hole at the target, in scene units."""
    nearest: float
    """z-depth of the nearest surfaces at the target, in scene units."""


@dataclass(frozen=True)
class Rated:
    """A candidate with its gain."""

    camera: Camera
    gain: float
    seen: Bool[Tensor, "n"]
    """Points beside the hole that it sees."""


def choose_cameras_around(
    scene: Gaussians,
    target: Camera,
    renderer: Renderer,
    holes: Bool[Tensor, "h w"] | None = None,
    count: int = MAX_CHOSEN_CAMERAS,
) -> list[Camera]:
    """Choose up to `count` cameras around a target, the best first; none if it sees no hole.

    `holes` are pixels of the target; by default those that the scene does not cover. The cameras
    have no near and far.
    """
    # Planes of the target need not suit cameras elsewhere, so the scene tells each one's near
    # plane.
    target = replace(target, near=None, far=None)
    small_scene = thin_gaussians(scene, MAX_PREVIEW_GAUSSIANS)
    border = find_hole_border(scene, small_scene, target, renderer, holes)
    if border is None:
        return []
    rate = partial(rate_camera, small_scene, border, target, renderer)
    candidates = propose_around(target, border)
    rated = list(get_view_map(scene.means)(rate, candidates))
    return choose_greedily(rated, border, count)


def find_hole_border(
    scene: Gaussians,
    small_scene: Gaussians,
    target: Camera,
    renderer: Renderer,
    holes: Bool[Tensor, "h w"] | None,
) -> HoleBorder | None:
    """Find the surfaces around the hole of a target; None without a hole or a surface."""
    if holes is None:
        holes = renderer.render(scene, add_near_plane(target, scene.means)).alpha < COVERED
    small = shrink_camera(add_near_plane(target, scene.means), COMPARED_SIDE)
    # A pixel of the small image is a hole if any of its pixels is: a mean would lose thin holes.
    size = (small.height, small.width)
    small_holes = adaptive_max_pool2d(holes[None, None].float(), size)[0, 0] > 0
    render = renderer.render(small_scene, small)
    covered = (render.alpha >= COVERED) & ~small_holes
    radius = max(round(BORDER_RADIUS * max(size)), 2)
    beside = dilate(small_holes, radius) & covered
    if not beside.any():
        return None
    points = unproject(render.depth, small)
    return HoleBorder(
        points[beside],
        points[covered],
        render.depth[beside].median().item(),
        render.depth[covered].quantile(NEAREST_TARGET_QUANTILE).item(),
    )


def propose_around(target: Camera, border: HoleBorder) -> list[Camera]:
    """Propose 40 cameras: moves of the target, straight or turned to the border, and turns."""
    axes = target.c2w[:3, :3].T
    up = -axes[1]
    middle = border.points.mean(dim=0)
    no_turn = torch.eye(3).to(axes)
    proposed = []
    for step in MOVE_LENGTHS:
        for direction in DIRECTIONS:
            along = torch.tensor(direction).to(axes)
            shift = step * border.depth * (along / along.norm()) @ axes
            moved = move_camera(target, no_turn, shift)
            proposed.append(moved)
            proposed.append(look_along(moved, middle - moved.center, up))

    wide, high = compute_field_of_view(target)
    for axis, angle in ((up, TURN * wide), (axes[0], TURN * high)):
        for sign in (1, -1):
            turn = axis_angle_to_matrix(axis, sign * angle)
            for side in (0, 1, -1):
                shift = side * STEP_WITH_TURN * border.depth * axes[0]
                proposed.append(move_camera(target, turn, shift))
    return proposed


def rate_camera(
    scene: Gaussians, border: HoleBorder, target: Camera, renderer: Renderer, camera: Camera
) -> Rated:
    """Rate a camera by what its render shows.

    The gain is the squared share of the image that is covered, times the share of the border that
    it sees, times its baseline up to what is enough, times one half to one by the share of the
    target's surfaces that it sees. It is 0 if something is too close.
    """
    small = shrink_camera(replace(camera, near=0.1 * border.nearest), COMPARED_SIDE)
    render = renderer.render(scene, small)
    covered = render.alpha >= COVERED
    close = covered & (render.depth < SURFACE_CLEARANCE * border.nearest)
    seen = find_seen(border.points, small, render)
    if close.float().mean().item() > MAX_CLOSE:
        return Rated(camera, 0.0, seen)
    baseline = measure_baseline(camera, target) / border.depth
    seen_of_all = find_seen(border.all_points, small, render).float().mean().item()
    gain = covered.float().mean().item() ** 2
    gain *= seen.float().mean().item()
    gain *= min(baseline / ENOUGH_BASELINE, 1.0)
    gain *= 0.5 + 0.5 * seen_of_all
    return Rated(camera, gain, seen)


def find_seen(points: Float[Tensor, "n 3"], camera: Camera, render: Render) -> Bool[Tensor, "n"]:
    """Find points that a camera sees, on its rendered surfaces or in front of them."""
    pixels, z = project(points, camera)
    inside = is_inside(pixels, z, camera)
    surface = sample(torch.stack([render.depth, render.alpha], dim=-1), pixels)
    return inside & (z < OCCLUSION * surface[:, 0]) & (surface[:, 1] >= COVERED)


def choose_greedily(rated: Sequence[Rated], border: HoleBorder, count: int) -> list[Camera]:
    """Choose cameras that each show a new part of the border, from a place of their own."""
    chosen: list[Rated] = []
    left = list(rated)
    known = torch.zeros_like(rated[0].seen)
    while left and len(chosen) < count:
        gains = [compute_gain_beside(one, chosen, known, border) for one in left]
        best = gains.index(max(gains))
        if gains[best] < MIN_CAMERA_GAIN:
            break
        known = known | left[best].seen
        chosen.append(left.pop(best))
    return [one.camera for one in chosen]


def compute_gain_beside(
    one: Rated, chosen: Sequence[Rated], known: Bool[Tensor, "n"], border: HoleBorder
) -> float:
    """Compute the gain of a camera beside those chosen, which see the `known` points."""
    new = (one.seen & ~known).float().mean().item()
    apart = min(
        (measure_baseline(one.camera, other.camera) / border.depth for other in chosen),
        default=ENOUGH_APART,
    )
    return one.gain * (KNOWN_WORTH + new) * min(apart / ENOUGH_APART, 1.0)
