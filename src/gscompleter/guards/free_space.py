"""Free space (not in the paper): nothing is added in front of observed surfaces.

In a hole only the lifted depth locates a Gaussian, but cameras exclude some positions: whatever
stands in front of a surface that a camera sees would hide it there. Such a Gaussian slides back
along its ray from the target camera until it hides no observed surface, or is dropped (decision
008). A Gaussian covers more than the pixel of its mean. So one whose mean is hidden by an object
slides, too, if it would show beside the edge of that object (decision 049).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
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
"""Step of a Gaussian along its ray, relative to its distance before the step."""
OCCLUSION_CLEARANCE = 0.01
"""Least distance behind an observed surface, relative to its depth, that counts as occluded.
A Gaussian there is invisible to the camera and still closes the hole."""
STEPS_AT_ONCE = 8
"""Steps that a GPU tests together, without an answer in between for which the host would wait."""
OUTER_BORDER = 3
"""Pixels beyond the border of an image up to which a Gaussian there still shows inside."""
FOOTPRINT_RADIUS = 3.0
"""Distance from its mean up to which a Gaussian is visible, in pixels of the target. Additions
have a standard deviation of half a pixel there, and renderers blur them by as much."""
FOOTPRINT_CLEARANCE = 0.02
"""Largest distance in front of the farthest surface of a footprint, relative to its depth, at
which a hidden mean counts as part of that surface, which may be slanted. With 0.05, more Gaussians
that show beside an edge would stay there."""


@dataclass(frozen=True)
class Observed:
    """The surfaces that a camera sees."""

    camera: Camera
    depth: Float[Tensor, "h w"]
    """z-depth in scene units, 0 where the camera sees no surface."""
    farthest: Float[Tensor, "h w"]
    """Largest of these depths within the footprint of an addition, in scene units."""

    @staticmethod
    def from_render(render: Render, camera: Camera, target: Camera) -> Observed:
        """Take the surfaces of a render; `target` is the camera that additions are made for."""
        surfaces = render.depth_map()
        depth = surfaces.depth.where(surfaces.valid, 0.0)
        # The footprint is given in pixels of the target. A camera with a longer focal length sees
        # it over more of its own.
        zoom = (camera.on_cpu.K[0, 0] / target.on_cpu.K[0, 0]).item()
        radius = round(FOOTPRINT_RADIUS * zoom)
        side = 2 * radius + 1
        farthest = max_pool2d(depth[None, None], side, stride=1, padding=radius)[0, 0]
        return Observed(camera, depth, farthest)


class FreeSpace(Guard):
    """Keep added Gaussians out of space that cameras of the scene see through."""

    name = "free-space"
    loss = "a filling would hide what other cameras see through it"

    def place(self, candidates: Gaussians, view: TargetView) -> Gaussians:
        """Slide candidates back until no camera sees through them; drop those without a place."""
        state = view.state
        # The context bounds free space only as far as it is trusted: what no photograph confirms
        # may be a floater.
        cameras = [photo.camera for photo in state.views]
        renders = [
            replace(frozen.render, alpha=state.trust.compute_alpha(frozen, camera))
            for frozen, camera in zip(view.freeze_views(state.views), cameras, strict=True)
        ]

        # Completed targets count, or else a later target hangs its additions before those of an
        # earlier one (decision 008), and so do cameras of further photographs (decision 029).
        # Both are rendered small, to save time.
        side = state.config.next_best_view.image_size
        further = [*state.free_space_cameras, *state.completed_cameras]
        small = [shrink_camera(camera, side) for camera in further]
        renders += [frozen.render for frozen in view.scenes.freeze_small(state.parts, small)]
        cameras += small

        observed = [
            ignore_removed(render, camera, view)
            for render, camera in zip(renders, cameras, strict=True)
        ]
        placed, is_placed = respect_free_space(
            candidates,
            view.camera.padded,
            cameras,
            observed,
            state.config.footprint,
            state.config.free_space,
        )
        return placed[is_placed]


def ignore_removed(render: Render, camera: Camera, view: TargetView) -> Render:
    """Let a camera observe nothing in pixels where something was removed from the scene.

    A render now shows there what stands behind the removed object. The space in front of that was
    filled by the object, so no photograph saw through it, and the fill may stand there.
    """
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
    """Slide Gaussians back along target rays out of free space; mark those that found a place.

    `renders` show the scene at `cameras`. With a constant `footprint` Gaussians grow with their
    distance, so that the image at the target stays the same. Those without a place end where the
    last step left them; the caller drops them.
    """
    observed = [
        Observed.from_render(render, camera, target)
        for render, camera in zip(renders, cameras, strict=True)
    ]
    # A position along a ray is a multiple of the distance that a Gaussian had at first, so that the
    # result does not depend on the scene unit.
    ratio = torch.ones_like(gaussians.opacities)
    offsets = gaussians.means - target.center
    is_waiting = torch.ones_like(ratio, dtype=torch.bool)
    at_once = STEPS_AT_ONCE if ratio.is_cuda else 1
    for start in range(0, config.num_steps, at_once):
        rows = list_rows(is_waiting)
        if len(rows) == 0:
            break
        count = min(at_once, config.num_steps - start)
        steps = [(1 + SLIDE_STEP) ** step for step in range(start, start + count + 1)]
        ratios = torch.tensor(steps).to(ratio.device, non_blocking=True)
        means = target.center + ratios[:-1, None, None] * offsets[rows]
        is_free = find_in_free_space(means.flatten(0, 1), observed).view(count, -1)
        # The place is the first that is not in free space. What has none yet goes on behind.
        num_steps = is_free.int().cumprod(dim=0).sum(dim=0)
        still = is_waiting[rows]
        ratio[rows] = torch.where(still, ratios[num_steps], ratio[rows])
        is_waiting[rows] = still & (num_steps == count)

    # The steps may end before the sky. What still waits is placed just behind the depth at which
    # the sky is drawn. There it counts as occluded, unless another camera sees through it.
    if is_sky_visible(renders, cameras):
        rows = list_rows(is_waiting)
        depths = compute_z_depths(gaussians.means[rows], target)
        behind = (1 + SLIDE_STEP) * compute_sky_depth(target) / depths
        means = target.center + behind[:, None] * offsets[rows]
        is_placed = is_waiting[rows] & ~find_in_free_space(means, observed)
        ratio[rows] = torch.where(is_placed, behind, ratio[rows])
        is_waiting[rows] = is_waiting[rows] & ~is_placed

    return slide(gaussians, target, ratio, footprint), ~is_waiting


def list_rows(chosen: Bool[Tensor, "n"]) -> Int64[Tensor, "m"]:
    """List the rows to compute: those that are chosen, or all of them on a GPU.

    There the host would wait for the number of rows longer than it takes to compute all.
    """
    if chosen.is_cuda:
        return torch.arange(len(chosen), device=chosen.device)
    return chosen.nonzero()[:, 0]


def find_in_free_space(
    points: Float[Tensor, "n 3"], observed: Sequence[Observed]
) -> Bool[Tensor, "n"]:
    """Find points in front of an observed surface, or inside the near distance of a camera."""
    is_free = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for surfaces in observed:
        # One camera is enough to exclude a point, so each tests only those that none did before it:
        # with 40 photographs this halves the time of stage 4 (decision 045).
        rows = list_rows(~is_free)
        is_free[rows] = is_free[rows] | is_before_surface(points[rows], surfaces)
    return is_free


def is_before_surface(points: Float[Tensor, "n 3"], observed: Observed) -> Bool[Tensor, "n"]:
    """Mark points in front of what a camera observes, or inside of its near distance.

    A point that a surface hides is marked too if its footprint reaches over the edge of that
    surface and covers another surface, which lies behind the point.
    """
    camera = observed.camera
    pixels, z = project(points, camera)
    x, y = pixels.unbind(-1)
    visible = (z > 0) & (pixels > -OUTER_BORDER).all(-1)
    visible &= (x < camera.width + OUTER_BORDER) & (y < camera.height + OUTER_BORDER)

    # A mean just outside of the image reads the pixel at its border, since the Gaussian still
    # covers that. The pixels of invisible means, which may be infinite, are replaced first.
    column = torch.where(visible, x, 0.0).long().clamp(0, camera.width - 1)
    row = torch.where(visible, y, 0.0).long().clamp(0, camera.height - 1)
    depth = observed.depth[row, column]

    # Depth is 0 where no surface is seen, so that nothing is in front of it.
    before = z < (1 + OCCLUSION_CLEARANCE) * depth
    # Half-way between an object and the wall, a mean is hidden by the object, but its footprint
    # shows beside the edge, before the wall (decision 049). It has to slide on to the wall. Where
    # its own pixel shows no surface, nothing hides it: it is in a hole of this camera and may stay.
    beside = (depth > 0) & (z < (1 - FOOTPRINT_CLEARANCE) * observed.farthest[row, column])
    # The near distance counts in any direction, in the image or not: without this rule,
    # photographs of a capture lost up to 8.6 dB (decision 029).
    is_near = (points - camera.center).norm(dim=-1) < (camera.near or 0.0)
    return (visible & (before | beside)) | is_near
