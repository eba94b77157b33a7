"""The surface behind something removed, seen head-on, as all photographs of the context show it.

A painter who continues a pattern sees it without perspective, and farther around than the target.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.generators.warp import warp_photographs
from gscompleter.numerics.geometry import axis_angle_to_matrix, pad_camera, unproject
from gscompleter.numerics.image_ops import dilate
from gscompleter.numerics.robust import fit_plane_ransac
from gscompleter.stages.select_anchor import find_nearest_view
from gscompleter.stages.synthesize import make_generator_input
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.types import Camera

SURROUNDINGS_WIDTH = 0.15
"""Width of the surroundings of a hole that a surface is fitted to, relative to the longer side."""
UNSURE_RIM = 0.01
"""Width of the part of them beside the hole that is left out, as depth is unsure there."""
PLANE_THICKNESS = 0.05
"""Distance in depth from the plane up to which something belongs to it, relative to its depth."""
MIN_PLANE_SHARE = 0.5
"""Share of the surroundings that has to lie on one plane."""
MIN_SURROUNDING_PIXELS = 100
"""Fewest pixels of surroundings."""
SIZE = 1.5
"""Side of the mosaic, relative to the longer side of the target's image."""


def draw_mosaic(view: TargetView) -> Float[Tensor, "s s 3"] | None:
    """Draw the plane around the holes of a target, head-on, black where no photograph shows it.

    Return None if the surroundings of the holes are no plane.
    """
    plane = fit_surroundings(view)
    if plane is None:
        return None
    camera = face_plane(plane, view.holes, view.camera.target)
    front = render_target(view.state, pad_camera(camera, 0.0), view.scenes)
    context = make_generator_input(front)
    nearest = context.views[find_nearest_view(camera, context.views)]
    warped = warp_photographs(nearest, camera, context)

    # What stands before the plane is no part of it. In the axes of the target, plane · x = 1.
    target = view.camera.target
    points = (unproject(warped.depth, camera) - target.center) @ target.c2w[:3, :3]
    is_surface = warped.known & ((points @ plane - 1).abs() < PLANE_THICKNESS)
    return warped.image.where(is_surface[..., None], 0.0)


def fit_surroundings(view: TargetView) -> Float[Tensor, "3"] | None:
    """Fit a plane to what surrounds the holes of a target; None if that is no plane.

    Its points x in the axes of the target have plane · x = 1.
    """
    surface = view.render.depth_map()
    longer = max(view.holes.shape)
    around = dilate(view.holes, round(SURROUNDINGS_WIDTH * longer)) & surface.valid
    around &= ~dilate(view.holes, max(round(UNSURE_RIM * longer), 1))
    if around.sum() < MIN_SURROUNDING_PIXELS:
        return None
    target = view.camera.target
    rays = (target.z_rays() @ target.c2w[:3, :3])[around]
    depths = surface.depth[around]
    plane = fit_plane_ransac(rays, depths, torch.Generator().manual_seed(0))
    is_near = (depths * (rays @ plane) - 1).abs() < PLANE_THICKNESS
    return plane if is_near.float().mean() >= MIN_PLANE_SHARE else None


def face_plane(plane: Float[Tensor, "3"], holes: Bool[Tensor, "h w"], target: Camera) -> Camera:
    """Place a camera that sees a plane head-on, in the middle of the holes and as large as there.

    `plane` is in the axes of the target, whose lens it keeps, in a larger image.
    """
    rays = target.z_rays() @ target.c2w[:3, :3]
    # The hole pixel nearest to the middle of all: it is one whose ray meets the plane in front.
    rows, columns = holes.nonzero().unbind(dim=1)
    distance = (rows - rows.float().mean()).square() + (columns - columns.float().mean()).square()
    nearest = distance.argmin()
    ray = rays[rows[nearest], columns[nearest]]
    middle = ray / (plane @ ray).clamp_min(1e-6 * plane.norm())

    # The smallest turn from the target's direction to the normal keeps what is up.
    normal = (plane / plane.norm()).double()
    axis = torch.stack([-normal[1], normal[0], torch.zeros_like(normal[0])])
    angle = math.atan2(axis.norm().item(), normal[2].item())
    turn = axis_angle_to_matrix(axis / axis.norm().clamp_min(1e-12), angle)
    center = middle.double() - middle.norm().double() * normal

    c2w = target.c2w.double().clone()
    c2w[:3, 3] += c2w[:3, :3] @ center
    c2w[:3, :3] = c2w[:3, :3] @ turn
    side = round(SIZE * max(holes.shape))
    K = target.K.clone()
    K[:2, 2] = side / 2
    return replace(target, c2w=c2w.to(target.c2w), K=K, width=side, height=side)
