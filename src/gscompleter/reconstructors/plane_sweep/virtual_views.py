"""Virtual photographs: what each photograph shows, from one baseline beyond its nearest neighbour.

Photographs do not determine the colours of many more Gaussians than pixels: fitted to them alone,
colours cancel errors of depth, pose and exposure there and look wrong from everywhere else. Virtual
photographs say what the scene should look like elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import is_inside, project, sample, unproject
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, DepthMap, Gaussians, View

COLOR_DEPTH_TOLERANCE = 0.03
"""Relative depth difference at which the share of a photograph's colour falls to 1/e."""


def make_virtual_views(
    scene: Gaussians, views: Sequence[View], depths: Sequence[DepthMap], renderer: Renderer
) -> list[View]:
    """Warp each photograph to a camera beyond it, through the depth of `scene` there.

    The camera continues the way from the nearest other photograph. `depths` are those of the scene
    at the photographs.
    """
    cameras = [view.camera for view in views]
    return [
        warp(
            view,
            depth,
            scene,
            extrapolate_camera(find_nearest_camera(view.camera, cameras), view.camera),
            renderer,
        )
        for view, depth in zip(views, depths, strict=True)
    ]


def find_nearest_camera(camera: Camera, cameras: Sequence[Camera]) -> Camera:
    """Find the nearest of `cameras` that stands in another place."""
    distances = torch.stack([(camera.center - other.center).norm() for other in cameras])
    # Cameras in one place give no direction to go on in.
    distances = torch.where(distances > 0, distances, torch.inf)
    return cameras[int(distances.argmin())]


def extrapolate_camera(before: Camera, camera: Camera) -> Camera:
    """Continue the motion from `before` to `camera` by as much again."""
    rotation = camera.c2w[:3, :3]
    c2w = camera.c2w.clone()
    # Cameras that move on without turning were slightly worse (decision 043).
    c2w[:3, :3] = rotation @ before.c2w[:3, :3].T @ rotation
    c2w[:3, 3] = 2 * camera.center - before.center
    return replace(camera, c2w=c2w)


def warp(view: View, own: DepthMap, scene: Gaussians, camera: Camera, renderer: Renderer) -> View:
    """Warp a photograph to another camera; what it does not show keeps the colours of `scene`."""
    # Backward warp: the depth that the scene draws in the virtual camera says where each of its
    # pixels lies in the photograph.
    shown = renderer.render(scene, camera)
    covered = shown.alpha >= COVERED
    pixels, z = project(unproject(shown.depth, camera), view.camera)
    layers = torch.cat([view.image, own.depth[..., None], own.valid[..., None]], dim=-1)
    sampled, depth, valid = sample(layers, pixels).split([3, 1, 1], dim=-1)

    # A surface that another one hides in the photograph is not sampled: the two depths differ.
    error = (z - depth[..., 0]) / (COLOR_DEPTH_TOLERANCE * z.abs().clamp_min(1e-12))
    seen = covered & is_inside(pixels, z, view.camera) & (valid[..., 0] >= 0.5)
    share = torch.exp(-error.square()) * seen

    # Where the scene ends it is half transparent, and a completion adds what is behind. Colours
    # divided by alpha would be too bright then (decision 043).
    wanted = shown.alpha[..., None] * sampled
    return View((shown.image + share[..., None] * (wanted - shown.image)).clamp(0, 1), camera)
