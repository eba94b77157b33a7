"""Free space (not in the paper): nothing is added in front of observed surfaces.

In a hole only the lifted depth locates a Gaussian, but photographs exclude some positions: one in
front of an observed surface slides back along its ray until no camera contradicts it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import FreeSpaceConfig
from gscompleter.geometry import compute_z_depths, project, shrink_camera, slide
from gscompleter.guards import Guard
from gscompleter.guards.removal import find_removed
from gscompleter.sky import compute_sky_depth, is_sky_visible
from gscompleter.stages.target_view import TargetView
from gscompleter.types import Camera, Gaussians, Render

SLIDE_STEP = 0.04
"""Step of a Gaussian along its ray, relative to its distance."""
CLEARANCE = 0.01
"""Distance behind an observed surface, relative to depth, that counts as occluded.
A Gaussian there is invisible to the camera and still closes the hole."""
BORDER = 3
"""Pixels outside of an image at which a Gaussian is still visible."""


class FreeSpace(Guard):
    """Keep added Gaussians out of space that cameras of the scene see through."""

    name = "free-space"

    def place(self, candidates: Gaussians, view: TargetView) -> Gaussians:
        """Slide candidates back until no photograph or completed target sees through them."""
        state = view.state
        completed = [result.target for result in state.targets if len(result.added)]
        side = state.config.next_best_view.image_size
        small = [shrink_camera(c, side) for c in (*state.free_space_cameras, *completed)]
        cameras = [photo.camera for photo in state.views]
        renders = [
            replace(frozen.render, alpha=state.trust.compute_alpha(frozen, camera))
            for frozen, camera in zip(view.at(state.views), cameras, strict=True)
        ]
        renders += [frozen.render for frozen in view.scenes.freeze_small(state.parts, small)]
        cameras += small
        placed, is_placed = respect_free_space(
            candidates,
            view.camera.padded,
            cameras,
            [ignore_removed(*pair, view) for pair in zip(renders, cameras, strict=True)],
            state.config.registration.footprint,
            state.config.free_space,
        )
        return placed[is_placed]


def ignore_removed(render: Render, camera: Camera, view: TargetView) -> Render:
    """Observe nothing where something was removed: what stands behind it bounds no free space."""
    source = view.state.source
    if len(source.removed) == 0:
        return render
    removed = find_removed(source, camera, view.scenes.renderer)
    return replace(render, alpha=render.alpha.where(~removed, 0.0))


def respect_free_space(
    gaussians: Gaussians,
    target: Camera,
    cameras: Sequence[Camera],
    renders: Sequence[Render],
    footprint: Literal["constant", "fixed"],
    config: FreeSpaceConfig = FreeSpaceConfig(),
) -> tuple[Gaussians, Bool[Tensor, "n"]]:
    """Slide Gaussians back along target rays out of free space; mark those that found a place."""
    ratio = torch.ones_like(gaussians.opacities)
    offsets = gaussians.means - target.center
    waiting = torch.arange(len(gaussians), device=ratio.device)
    for step in range(config.num_steps):
        means = target.center + ratio[waiting, None] * offsets[waiting]
        waiting = waiting[find_in_free_space(means, cameras, renders)]
        if len(waiting) == 0:
            break
        ratio[waiting] = (1 + SLIDE_STEP) ** (step + 1)
    if any(is_sky_visible(render, camera) for render, camera in zip(renders, cameras, strict=True)):
        # Gaussians that find no position up to the sky become part of the sky.
        depths = compute_z_depths(gaussians.means[waiting], target)
        behind = (1 + SLIDE_STEP) * compute_sky_depth(target) / depths
        means = target.center + behind[:, None] * offsets[waiting]
        found = ~find_in_free_space(means, cameras, renders)
        ratio[waiting[found]] = behind[found]
        waiting = waiting[~found]
    placed = torch.ones_like(ratio, dtype=torch.bool)
    placed[waiting] = False
    return slide(gaussians, target, ratio, footprint), placed


def find_in_free_space(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera], renders: Sequence[Render]
) -> Bool[Tensor, "n"]:
    """Find points in front of an observed surface, or inside the near distance of a camera."""
    left = torch.arange(len(points), device=points.device)
    for camera, render in zip(cameras, renders, strict=True):
        left = left[~is_before_surface(points[left], camera, render)]
    return torch.ones(len(points), dtype=torch.bool, device=points.device).index_fill(
        0, left, False
    )


def is_before_surface(
    points: Float[Tensor, "n 3"], camera: Camera, render: Render
) -> Bool[Tensor, "n"]:
    """Mark points in front of what a camera observes, or inside of its near distance."""
    pixels, z = project(points, camera)
    size = torch.tensor([camera.width, camera.height], device=pixels.device)
    visible = (z > 0) & (pixels > -BORDER).all(-1) & (pixels < size + BORDER).all(-1)
    nearest = torch.where(visible[:, None], pixels, 0.0).long().clamp_min(0)
    x, y = torch.minimum(nearest, size - 1).unbind(-1)
    scene = render.depth_map()
    before = z < (1 + CLEARANCE) * scene.depth[y, x]
    is_near = (points - camera.center).norm(dim=-1) < (camera.near or 0.0)
    return (visible & scene.valid[y, x] & before) | is_near
