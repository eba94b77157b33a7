"""Stage 3, fine: Gaussians slide along rays to agree with the scene (paper, Sec. III-E)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.config import RegistrationConfig
from gscompleter.numerics.adam import Adam
from gscompleter.numerics.geometry import compute_z_depths, move_to_depths, slide
from gscompleter.numerics.image_ops import fill_smoothly
from gscompleter.numerics.sky import compute_sky_depth, is_sky, mask_out_sky
from gscompleter.render.protocols import FrozenScene, Renderer
from gscompleter.stages.target_view import TargetView
from gscompleter.system.progress import track
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.system.timing import timed_stage
from gscompleter.types import Camera, DepthAffine, DepthMap, Gaussians, Lift, Render, View

OCCLUSION_TOLERANCE = 0.05
"""Distance behind the context, relative to depth, that still counts as the same surface."""
EXTRAPOLATION_TOLERANCE = 0.02
"""Largest relative depth error of a pixel whose correction is extrapolated into holes."""
MAX_COLOR_DIFFERENCE = 0.1
"""Largest colour difference per channel between a hole and the sky that is extrapolated."""


@dataclass(frozen=True)
class Registration:
    """Registered Gaussians."""

    gaussians: Gaussians
    pixel_index: Int[Tensor, "n"] | None
    """Row-major pixel of the reference that each Gaussian comes from, or None if unknown."""
    losses: tuple[float, ...]
    """Value of Eq. 11 at each iteration."""


@timed_stage("register")
@use_one_torch_thread()
def slide_along_rays(
    lift: Lift, affine: DepthAffine, reference: View, view: TargetView
) -> Registration:
    """Register lifted Gaussians: all by one affine (Eq. 9), then each along its ray (Eq. 10)."""
    config, pixel_index = view.state.config.registration, lift.pixel_index
    camera = reference.camera
    coarse = apply_affine(lift.gaussians, affine, camera, config.footprint, config.min_ratio)
    if config.iterations == 0:
        return Registration(coarse, pixel_index, ())
    if config.hole_depth == "scene" and pixel_index is not None:
        depth = fill_smoothly(view.render.depth, ~view.holes).flatten()[pixel_index]
        return Registration(move_to_depths(coarse, camera, depth), pixel_index, ())
    if config.extrapolate_into_holes and config.degrees_of_freedom == 1 and pixel_index is not None:
        return register_beside_holes(coarse, pixel_index, reference, view)
    registered, losses = register_along_rays(coarse, reference, view)
    return Registration(registered, pixel_index, losses)


def register_beside_holes(
    coarse: Gaussians, pixel_index: Int[Tensor, "n"], reference: View, view: TargetView
) -> Registration:
    """Register Gaussians that overlap the scene, and move those in holes like them."""
    scene = view.render.depth_map(view.state.config.holes.max_alpha)
    camera, config = reference.camera, view.state.config.registration
    rows = torch.nonzero(scene.valid.flatten()[pixel_index])[:, 0]
    registered, losses = register_along_rays(coarse[rows], reference, view)
    ratios = extrapolate_into_holes(coarse[rows], registered, pixel_index[rows], scene, camera)
    moved = slide(coarse, camera, ratios.flatten()[pixel_index], config.footprint)
    return Registration(extrapolate_sky(moved, pixel_index, scene, reference), pixel_index, losses)


def extrapolate_into_holes(
    coarse: Gaussians,
    registered: Gaussians,
    pixels: Int[Tensor, "n"],
    scene: DepthMap,
    camera: Camera,
) -> Float[Tensor, "h w"]:
    """Compute the correction d' / d of each pixel; well registered ones are extrapolated smoothly.

    `pixels` are those of the Gaussians, where `scene` is valid; it is extrapolated elsewhere.
    """
    depths = compute_z_depths(registered.means, camera)
    correction = torch.zeros_like(scene.depth).flatten()
    correction[pixels] = (depths / compute_z_depths(coarse.means, camera)).log()
    known = torch.zeros_like(scene.valid).flatten()
    error = (depths / scene.depth.flatten()[pixels].clamp_min(1e-12) - 1).abs()
    known[pixels] = error < EXTRAPOLATION_TOLERANCE
    correction, known = correction.view_as(scene.depth), known.view_as(scene.valid)
    return torch.where(scene.valid, correction, fill_smoothly(correction, known)).exp()


def extrapolate_sky(
    candidates: Gaussians, pixel_index: Int[Tensor, "n"], scene: DepthMap, reference: View
) -> Gaussians:
    """Move Gaussians of holes that continue the sky to its depth.

    `scene` is the depth at the target; its invalid pixels are holes.
    """
    camera = reference.camera
    sky = scene.valid & is_sky(scene.depth, camera)
    if not sky.any():
        return candidates
    continued = find_sky_continuation(sky, scene.valid, reference.image).flatten()[pixel_index]
    depths = compute_z_depths(candidates.means, camera)
    return move_to_depths(candidates, camera, depths.where(~continued, compute_sky_depth(camera)))


def find_sky_continuation(
    sky: Bool[Tensor, "h w"], known: Bool[Tensor, "h w"], image: Float[Tensor, "h w 3"]
) -> Bool[Tensor, "h w"]:
    """Find hole pixels whose nearest known pixel is sky of a similar colour."""
    _, labels = cv2.distanceTransformWithLabels(
        (~known).cpu().numpy().astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = torch.from_numpy(labels).long().to(known.device)
    pixel = torch.zeros(int(label.max()) + 1, dtype=torch.long, device=known.device)
    at = torch.nonzero(known.flatten())[:, 0]
    pixel[label.flatten()[at]] = at
    nearest = pixel[label]
    colours = image.reshape(-1, 3)[nearest]
    like = (image - colours).abs().amax(dim=-1) < MAX_COLOR_DIFFERENCE
    return ~known & sky.flatten()[nearest] & like


def apply_affine(
    gaussians: Gaussians,
    affine: DepthAffine,
    camera: Camera,
    footprint: Literal["constant", "fixed"],
    min_ratio: float | None = RegistrationConfig.min_ratio,
) -> Gaussians:
    """Move Gaussians along their rays to z-depth `scale * z + shift`, at least `min_ratio * z`.

    The ray distance follows from the means, d' = d z'/z: the paper's Eq. 9 without a depth map.
    """
    z = compute_z_depths(gaussians.means, camera)
    ratio = (affine.scale * z + affine.shift) / z
    return slide(gaussians, camera, bound(ratio, min_ratio), footprint)


def bound(ratio: Float[Tensor, "n"], least: float | None) -> Float[Tensor, "n"]:
    """Bound distance ratios from below, if a bound is given."""
    return ratio if least is None else ratio.clamp_min(least)


def register_along_rays(
    coarse: Gaussians, reference: View, view: TargetView
) -> tuple[Gaussians, tuple[float, ...]]:
    """Minimize Eq. 11 over one distance per Gaussian; also return the loss per iteration."""
    if len(coarse) == 0:
        return coarse, ()
    config, renderer = view.state.config.registration, view.scenes.renderer
    anchor = view.anchor_view.camera
    objective = Objective.from_renders(view.render, view.anchor_render, reference, anchor, config)
    alone = make_renderer_alone(coarse, reference.camera, renderer, config)
    parameters = torch.zeros(
        (len(coarse), config.degrees_of_freedom), device=coarse.means.device, requires_grad=True
    )
    optimizer = Adam([(parameters, config.learning_rate)], (config.beta1, config.beta2))
    losses = []
    for iteration in track(range(config.iterations), "Registering"):
        left = 1 - iteration / config.iterations if config.lr_schedule == "linear" else 1.0
        moved = move_along_rays(coarse, parameters, reference.camera, config)
        loss = objective(moved, view.frozen, alone, renderer.render(moved, anchor))
        optimizer.step(loss, left)
        losses.append(loss.detach())
    with torch.no_grad():
        moved = move_along_rays(coarse, parameters, reference.camera, config)
    # Read together at the end: a GPU would have to finish each step before the next begins.
    return moved, tuple(torch.stack(losses).tolist())


def move_along_rays(
    coarse: Gaussians,
    parameters: Float[Tensor, "n dof"],
    camera: Camera,
    config: RegistrationConfig,
) -> Gaussians:
    """Move Gaussians along their target rays (Eq. 10), or freely if `degrees_of_freedom` is 3."""
    offsets = coarse.means - camera.center
    distances = offsets.norm(dim=1, keepdim=True)
    unit = distances if config.lr_unit == "distance" else torch.ones_like(distances)
    if config.degrees_of_freedom == 3:
        return replace(coarse, means=coarse.means + unit * parameters, encoded=None)
    ratio = 1 + (unit * parameters / distances)[:, 0]
    return slide(coarse, camera, bound(ratio, config.min_ratio), config.footprint)


def make_renderer_alone(
    coarse: Gaussians, camera: Camera, renderer: Renderer, config: RegistrationConfig
) -> Callable[[Gaussians], Render]:
    """Return a renderer of moved Gaussians alone.

    With a constant footprint their image does not change along rays, so only depth is rendered
    again.
    """
    if config.degrees_of_freedom == 3 or config.footprint == "fixed":
        return lambda moved: renderer.render(moved, camera)
    plan = renderer.freeze(coarse[:0], camera).vary_depths(coarse)
    return lambda moved: plan(compute_z_depths(moved.means, camera))


def get_compared_depth(render: Render, camera: Camera, config: RegistrationConfig) -> DepthMap:
    """Return the rendered depth that losses compare with, without the sky if `mask_sky` is set."""
    return mask_out_sky(render, camera) if config.mask_sky else render.depth_map()


@dataclass(frozen=True)
class Objective:
    """Loss `λ_d L_depth + λ_s L_stereo + λ_c L_rgb` (paper, Eq. 11), as means over the image."""

    target_depth: DepthMap
    anchor_depth: DepthMap
    image: Float[Tensor, "h w 3"]
    unit: float
    """Divisor of depth residuals, in scene units."""
    config: RegistrationConfig

    @staticmethod
    def from_renders(
        at_target: Render,
        at_anchor: Render,
        reference: View,
        anchor: Camera,
        config: RegistrationConfig,
    ) -> Objective:
        """Create the objective from renders of the scene at target and anchor."""
        anchor_depth = get_compared_depth(at_anchor, anchor, config)
        seen = anchor_depth.depth[anchor_depth.valid]
        relative = config.lr_unit == "distance" and len(seen) > 0
        unit = seen.median().item() if relative else 1.0
        target_depth = get_compared_depth(at_target, reference.camera, config)
        return Objective(target_depth, anchor_depth, reference.image, unit, config)

    def __call__(
        self,
        candidates: Gaussians,
        frozen_target: FrozenScene,
        alone: Callable[[Gaussians], Render],
        at_anchor: Render,
    ) -> Float[Tensor, ""]:
        """Compute the loss; `alone` renders `candidates` at the target without the scene."""
        c = self.config
        loss = torch.zeros((), device=candidates.means.device)
        if c.rendered_depth == "composite" or c.rgb_weight > 0:
            together = frozen_target.composite(candidates)
            loss = loss + c.rgb_weight * (together.image - self.image).abs().mean()
        shown = together if c.rendered_depth == "composite" else alone(candidates)
        loss = loss + c.depth_weight * self.compute_depth_error(
            shown, self.target_depth, self.target_depth.valid & shown.depth_map().valid
        )
        return loss + c.stereo_weight * self.compute_depth_error(
            at_anchor, self.anchor_depth, self.find_comparable(at_anchor)
        )

    def compute_depth_error(
        self, shown: Render, expected: DepthMap, where: Tensor
    ) -> Float[Tensor, ""]:
        """Compute the L1 depth error inside `where`, in `unit`, averaged over the image."""
        error = (shown.depth - expected.depth).abs() / self.unit
        return torch.where(where, error, 0.0).mean()

    def find_comparable(self, alone: Render) -> Tensor:
        """Find anchor pixels that show the scene and unoccluded Gaussians."""
        seen = self.anchor_depth.valid & alone.depth_map().valid
        if not self.config.mask_occluded:
            return seen
        behind = alone.depth.detach() > self.anchor_depth.depth * (1 + OCCLUSION_TOLERANCE)
        return seen & ~behind
