"""Virtual photographs beyond a pair: what each of the two shows, from one baseline further on.

Two photographs do not determine the colours of twice as many Gaussians: fitted to both alone, they
cancel errors of depth, pose and exposure there and look wrong from everywhere else. Virtual
photographs say what the scene should look like elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.geometry import is_inside, project, sample, unproject
from gscompleter.render import Renderer
from gscompleter.types import Camera, Gaussians, Render, View

DEPTH_TOLERANCE = 0.03
"""Relative depth difference at which the share of a photograph's colour falls to 1/e."""


def make_virtual_views(
    scene: Gaussians, views: Sequence[View], renderer: Renderer
) -> tuple[View, View]:
    """Warp two photographs, through the depth of `scene`, to one camera beyond each of them."""
    first, second = ((view, renderer.render(scene, view.camera)) for view in views)

    def look_beyond(far: tuple[View, Render], near: tuple[View, Render]) -> View:
        camera = extrapolate_camera(far[0].camera, near[0].camera)
        shown = renderer.render(scene, camera)
        points, image = unproject(shown.depth, camera), shown.image
        for photograph in (far, near):
            colors, share = warp(*photograph, points)
            image = torch.lerp(image, colors, (share * (shown.alpha >= COVERED))[..., None])
        return View(image.clamp(0, 1), camera)

    return look_beyond(second, first), look_beyond(first, second)


def extrapolate_camera(before: Camera, camera: Camera) -> Camera:
    """Continue the motion from `before` to `camera` by as much again."""
    rotation, center = camera.c2w[:3, :3], 2 * camera.center - before.center
    c2w = camera.c2w.clone()
    c2w[:3, :3] = rotation @ before.c2w[:3, :3].T @ rotation
    c2w[:3, 3] = center
    return replace(camera, c2w=c2w)


def warp(
    view: View, render: Render, points: Float[Tensor, "h w 3"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Sample a photograph at surface points, with weights in [0, 1] that tell if it shows them."""
    pixels, z = project(points, view.camera)
    layers = torch.cat([view.image, render.depth[..., None], render.alpha[..., None]], dim=-1)
    colors, depth, alpha = sample(layers, pixels).split([3, 1, 1], dim=-1)
    error = (z - depth[..., 0]) / (DEPTH_TOLERANCE * z.abs().clamp_min(1e-12))
    seen = is_inside(pixels, z, view.camera) & (alpha[..., 0] >= COVERED)
    return colors, torch.exp(-error.square()) * seen
