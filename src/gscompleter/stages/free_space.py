"""Stage 3, ours: what a photograph saw through stays empty.

Inside a hole nothing tells a candidate its depth but what was lifted. The photographs do tell where
it cannot be: a candidate that would stand before what a context camera sees of the scene slides
back along its own ray until no camera contradicts it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import FreeSpaceConfig
from gscompleter.geometry import project, slide, z_depths
from gscompleter.sky import shows_sky, sky_depth
from gscompleter.types import Camera, Gaussians, Render

STEP = 0.04
"""By how much a candidate slides each time, relative to its distance."""
CLEARANCE = 0.01
"""How far behind the scene's surface, relative to depth, a camera that sees this surface must find
the candidate. What lies a little behind is hidden there, and still closes the hole."""
BORDER = 3
"""Pixels beyond the border of an image at which a Gaussian still shows within it."""


def respect_free_space(
    gaussians: Gaussians,
    target: Camera,
    cameras: Sequence[Camera],
    renders: Sequence[Render],
    footprint: Literal["constant", "fixed"],
    config: FreeSpaceConfig = FreeSpaceConfig(),
) -> tuple[Gaussians, Bool[Tensor, "n"]]:
    """`gaussians` moved back along the rays of `target` to where no camera saw through them, and
    which of them found a place [n].

    Args:
        gaussians: Candidates.
        target: Camera whose rays they slide along.
        cameras: The context cameras.
        renders: The scene as these see it.
        footprint: Whether sizes follow the distance, as in `slide`.
        config: How often they may slide.
    """
    if config.num_steps == 0:
        return gaussians, torch.ones_like(gaussians.opacities, dtype=torch.bool)
    ratio = torch.ones_like(gaussians.opacities)
    offsets = gaussians.means - target.center
    waiting = torch.arange(len(gaussians), device=ratio.device)
    for step in range(config.num_steps):
        means = target.center + ratio[waiting, None] * offsets[waiting]
        waiting = waiting[seen_through(means, cameras, renders)]
        if len(waiting) == 0:
            break
        ratio[waiting] = (1 + STEP) ** (step + 1)
    if any(shows_sky(render, camera) for render, camera in zip(renders, cameras, strict=True)):
        # What is seen through all the way to the sky is sky.
        behind = (1 + STEP) * sky_depth(target) / z_depths(gaussians.means[waiting], target)
        means = target.center + behind[:, None] * offsets[waiting]
        found = ~seen_through(means, cameras, renders)
        ratio[waiting[found]] = behind[found]
        waiting = waiting[~found]
    placed = torch.ones_like(ratio, dtype=torch.bool)
    placed[waiting] = False
    return slide(gaussians, target, ratio, footprint), placed


def seen_through(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera], renders: Sequence[Render]
) -> Bool[Tensor, "n"]:
    """Which points stand before what some camera sees of the scene, or where the camera itself
    stood: nearer to its centre, in whatever direction, than anything it sees."""
    contradicted = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for camera, render in zip(cameras, renders, strict=True):
        pixels, z = project(points, camera)
        size = torch.tensor([camera.width, camera.height], device=pixels.device)
        shows = (z > 0) & (pixels > -BORDER).all(-1) & (pixels < size + BORDER).all(-1)
        nearest = torch.where(shows[:, None], pixels, 0.0).long().clamp_min(0)
        x, y = torch.minimum(nearest, size - 1).unbind(-1)
        scene = render.depth_map()
        before = z < (1 + CLEARANCE) * scene.depth[y, x]
        contradicted |= shows & scene.valid[y, x] & before
        if camera.near is not None:
            contradicted |= (points - camera.center).norm(dim=-1) < camera.near
    return contradicted
