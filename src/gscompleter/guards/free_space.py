"""Free space (not in the paper): nothing is added in front of observed surfaces.

In a hole only the lifted depth locates a Gaussian, but photographs exclude some positions: one in
front of an observed surface slides back along its ray until no camera contradicts it. A Gaussian
covers more than the pixel of its mean: beside the edge of an object that hides it, it would still
occlude the surface behind that edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from gscompleter.config import FreeSpaceConfig
from gscompleter.guards import Guard
from gscompleter.numerics.geometry import compute_z_depths, project, shrink_camera, slide
from gscompleter.numerics.sky import compute_sky_depth, is_sky_visible
from gscompleter.render.removed import find_removed
from gscompleter.stages.target_view import TargetView
from gscompleter.types import Camera, Gaussians, Render

SLIDE_STEP = 0.04
"""Step of a Gaussian along its ray, relative to its distance."""
CLEARANCE = 0.01
"""Distance behind an observed surface, relative to depth, that counts as occluded.
A Gaussian there is invisible to the camera and still closes the hole."""
BORDER = 3
"""Pixels outside of an image at which a Gaussian is still visible."""
FOOTPRINT_RADIUS = 3.0
"""Pixels of the target around that of its mean in which a Gaussian is still visible. Additions have
a standard deviation of half a pixel there, and renderers blur them by as much."""
FOOTPRINT_CLEARANCE = 0.02
"""Distance in front of a surface in these pixels, relative to depth, that still counts as the same
surface, which may be slanted. With 0.05 more of what shows beside edges stays."""


@dataclass(frozen=True)
class Observed:
    """The surfaces that a camera sees."""

    camera: Camera
    depth: Float[Tensor, "h w"]
    """z-depth in scene units, 0 where the camera sees no surface."""
    farthest: Float[Tensor, "h w"]
    """Largest of these depths within the footprint of an addition."""

    @staticmethod
    def from_render(render: Render, camera: Camera, target: Camera) -> Observed:
        """Take the surfaces of a render; additions are about a pixel of the target wide."""
        seen = render.depth_map()
        depth = seen.depth.where(seen.valid, 0.0)
        zoom = (camera.K[0, 0] / target.K[0, 0]).item()
        radius = round(FOOTPRINT_RADIUS * zoom)
        side = 2 * radius + 1
        farthest = max_pool2d(depth[None, None], side, stride=1, padding=radius)[0, 0]
        return Observed(camera, depth, farthest)


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
            state.config.footprint,
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
    pairs = zip(renders, cameras, strict=True)
    observed = [Observed.from_render(render, camera, target) for render, camera in pairs]
    for step in range(config.num_steps):
        means = target.center + ratio[waiting, None] * offsets[waiting]
        waiting = waiting[find_in_free_space(means, observed)]
        if len(waiting) == 0:
            break
        ratio[waiting] = (1 + SLIDE_STEP) ** (step + 1)
    if any(is_sky_visible(render, camera) for render, camera in zip(renders, cameras, strict=True)):
        # Gaussians that find no position up to the sky become part of the sky.
        depths = compute_z_depths(gaussians.means[waiting], target)
        behind = (1 + SLIDE_STEP) * compute_sky_depth(target) / depths
        means = target.center + behind[:, None] * offsets[waiting]
        found = ~find_in_free_space(means, observed)
        ratio[waiting[found]] = behind[found]
        waiting = waiting[~found]
    placed = torch.ones_like(ratio, dtype=torch.bool)
    placed[waiting] = False
    return slide(gaussians, target, ratio, footprint), placed


def find_in_free_space(
    points: Float[Tensor, "n 3"], observed: Sequence[Observed]
) -> Bool[Tensor, "n"]:
    """Find points in front of an observed surface, or inside the near distance of a camera."""
    left = torch.arange(len(points), device=points.device)
    for surfaces in observed:
        left = left[~is_before_surface(points[left], surfaces)]
    return torch.ones(len(points), dtype=torch.bool, device=points.device).index_fill(
        0, left, False
    )


def is_before_surface(points: Float[Tensor, "n 3"], observed: Observed) -> Bool[Tensor, "n"]:
    """Mark points in front of what a camera observes, or inside of its near distance.

    A point that a surface hides is marked too if its footprint reaches over the edge of that
    surface, to one behind the point.
    """
    camera = observed.camera
    pixels, z = project(points, camera)
    size = torch.tensor([camera.width, camera.height], device=pixels.device)
    visible = (z > 0) & (pixels > -BORDER).all(-1) & (pixels < size + BORDER).all(-1)
    nearest = torch.where(visible[:, None], pixels, 0.0).long().clamp_min(0)
    x, y = torch.minimum(nearest, size - 1).unbind(-1)
    depth = observed.depth[y, x]
    before = z < (1 + CLEARANCE) * depth
    beside = (depth > 0) & (z < (1 - FOOTPRINT_CLEARANCE) * observed.farthest[y, x])
    is_near = (points - camera.center).norm(dim=-1) < (camera.near or 0.0)
    return (visible & (before | beside)) | is_near
