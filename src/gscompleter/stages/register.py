"""Registration of the lifted Gaussians as we do it: Sec. III-E of the paper, with departures.

`register_paper.py` is the paper's. Each departure is named where it is made, with its reason.
Distances and depths are in scene units, and images are those of the padded target camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.config import RegistrationConfig
from gscompleter.numerics.adam import Adam
from gscompleter.numerics.geometry import compute_z_depths, look_up, move_to_depths, slide
from gscompleter.numerics.image_ops import fill_smoothly
from gscompleter.numerics.sky import mask_out_sky
from gscompleter.render.protocols import JointScene, Renderer
from gscompleter.stages.extrapolate_registration import extrapolate_into_holes, extrapolate_sky
from gscompleter.stages.select_anchor import Anchor
from gscompleter.stages.target_view import TargetView
from gscompleter.system.progress import track
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.system.timing import timed_stage
from gscompleter.types import (
    Camera,
    DepthAffine,
    DepthMap,
    Gaussians,
    Lift,
    Registration,
    Render,
    View,
)

MIN_RATIO = 0.1
"""Smallest ratio of a new distance to the old one: an affine with a negative shift would push near
Gaussians through the camera."""
ADAM_BETAS = (0.0, 0.8)
"""Adam's decay rates of the mean of gradients and of that of their squares. The usual 0.9 and 0.999
overshoot in so few steps (decision 003)."""
OCCLUSION_TOLERANCE = 0.05
"""Depth behind the context, relative to its depth, that still counts as the same surface."""
IN_FRONT = 0.98
"""Largest depth of what fills a forced hole, relative to that of what is left in it."""

RenderAlone = Callable[[Gaussians], tuple[Render, Render]]
"""Renders Gaussians at the target and at the anchor, without the scene."""


@timed_stage("register")
@use_one_torch_thread()
def register_along_rays(
    lifted: Lift, affine: DepthAffine, reference: View, anchor: Anchor, view: TargetView
) -> Registration:
    """Align all Gaussians by one affine of depth, then each along its ray, as the config says.

    Args:
        lifted: Gaussians of the reference, each with its pixel if the model tells it.
        affine: Affine from their z-depths to those of the scene (Eq. 8).
        reference: The synthesized image at the padded target camera.
        anchor: The photograph that depth is compared at, besides the target.
        view: The scene at the target.

    Returns:
        The same Gaussians in their order, moved along the rays of the target (with three degrees of
        freedom, anywhere).
    """
    registered = register_lifted(lifted, affine, reference, anchor, view)
    if reference.given_depth is None:
        return registered
    # Geometry from elsewhere is a measurement, already bent to what the scene shows around the
    # hole. The losses of the registration know no depth of a hole, so it comes after them.
    given = bring_before_forced(reference.given_depth, view)
    gaussians = place_at_depths(
        registered.gaussians, registered.pixel_index, reference.camera, given
    )
    return replace(registered, gaussians=gaussians)


def place_at_depths(
    gaussians: Gaussians,
    pixel_index: Int[Tensor, "n"] | None,
    camera: Camera,
    depth: Float[Tensor, "h w"],
) -> Gaussians:
    """Move Gaussians to the z-depth of their pixel, or of the pixel that shows their mean.

    Where `depth` is 0, which is unknown, they stay.
    """
    if pixel_index is None:
        depths = look_up(depth, gaussians, camera)
    else:
        depths = depth.flatten()[pixel_index]
    z = compute_z_depths(gaussians.means, camera)
    return move_to_depths(gaussians, camera, depths.where(depths > 0, z))


def bring_before_forced(depth: Float[Tensor, "h w"], view: TargetView) -> Float[Tensor, "h w"]:
    """Bring a z-depth at the padded target before what is left in forced holes.

    What is left there is wrong, and must not hide what fills it.
    """
    forced = view.masks.edits.forced
    if forced is None:
        return depth
    left = view.render.depth_map(view.state.config.holes.max_alpha)
    in_front = torch.minimum(depth, IN_FRONT * left.depth)
    return torch.where(forced & left.valid, in_front, depth)


def register_lifted(
    lifted: Lift, affine: DepthAffine, reference: View, anchor: Anchor, view: TargetView
) -> Registration:
    """Register Gaussians by what the scene shows; arguments as in `register_along_rays`."""
    config = view.state.config.registration
    pixel_index = lifted.pixel_index
    camera = reference.camera
    coarse = apply_affine(lifted.gaussians, affine, camera)
    if config.iterations == 0:
        return Registration(coarse, pixel_index, ())
    if pixel_index is None:
        # Voxel-aligned models do not say which pixel a Gaussian belongs to, so that neither a depth
        # map of the scene nor one of corrections is that of a Gaussian. `hole_depth` and
        # `extrapolate_into_holes` then have no effect.
        registered, losses = optimize_distances(coarse, reference, anchor, view)
        return Registration(registered, None, losses)
    if config.hole_depth == "scene":
        # A trained splat has its depth from many photographs, which two-view stereo cannot better.
        # Nothing is left to optimize.
        depth = continue_scene_depth(view, reference)
        placed = place_at_depths(coarse, pixel_index, camera, depth)
        return Registration(placed, pixel_index, ())
    if config.extrapolate_into_holes and config.degrees_of_freedom == 1:
        return register_beside_holes(coarse, pixel_index, reference, anchor, view)
    registered, losses = optimize_distances(coarse, reference, anchor, view)
    return Registration(registered, pixel_index, losses)


def continue_scene_depth(view: TargetView, reference: View) -> Float[Tensor, "h w"]:
    """Compute the z-depth of the scene at the padded target, continued smoothly into its holes.

    A given depth of the reference is continued like that of the scene. In a forced hole the depth
    is before what is left there. It is 0 if the target sees no surface.
    """
    surface = view.render.depth_map(view.state.config.holes.max_alpha)
    # Beside an object there is neither a hole nor a depth.
    known = ~view.holes & surface.valid
    depth = surface.depth
    if reference.given_depth is not None:
        is_given = reference.given_depth > 0
        depth = torch.where(is_given, reference.given_depth, depth)
        known = known | is_given
    # Where nothing is trusted, or all was marked as wrong, the depth of what is seen is still
    # nearer to the truth than none.
    known = known | (surface.valid & ~known.any())
    return bring_before_forced(fill_smoothly(depth, known), view)


def register_beside_holes(
    coarse: Gaussians,
    pixel_index: Int[Tensor, "n"],
    reference: View,
    anchor: Anchor,
    view: TargetView,
) -> Registration:
    """Register Gaussians that overlap the scene, and move those in holes like those around.

    No loss acts inside a hole. In the paper its pixels keep the affine while those around it move,
    which leaves a step of depth at the border (decision 005). `coarse` are the Gaussians after the
    affine.
    """
    camera = reference.camera
    surface = view.render.depth_map(view.state.config.holes.max_alpha)
    scene = replace(surface, valid=surface.valid & ~view.empty)
    overlapping = torch.nonzero(scene.valid.flatten()[pixel_index])[:, 0]
    registered, losses = optimize_distances(coarse[overlapping], reference, anchor, view)
    ratios = extrapolate_into_holes(
        coarse[overlapping], registered, pixel_index[overlapping], scene, camera
    )
    moved = slide(coarse, camera, ratios.flatten()[pixel_index], "constant")
    return Registration(extrapolate_sky(moved, pixel_index, scene, reference), pixel_index, losses)


def apply_affine(gaussians: Gaussians, affine: DepthAffine, camera: Camera) -> Gaussians:
    """Move Gaussians along their rays to z-depth `scale * z + shift` (Eq. 9).

    The paper keeps their sizes. With a constant footprint the image at the target stays exactly
    what it was, and only depth and order have to be rendered again (decision 002).
    """
    z = compute_z_depths(gaussians.means, camera)
    ratio = (affine.scale * z + affine.shift) / z
    return slide(gaussians, camera, ratio.clamp_min(MIN_RATIO), "constant")


def optimize_distances(
    coarse: Gaussians, reference: View, anchor: Anchor, view: TargetView
) -> tuple[Gaussians, tuple[float, ...]]:
    """Minimize Eq. 11 over the distances of Gaussians; also return the loss before each step.

    `coarse` are the Gaussians after the affine. With three degrees of freedom their positions are
    optimized instead.
    """
    if len(coarse) == 0:
        return coarse, ()
    config = view.state.config.registration
    renderer = view.scenes.renderer
    at_anchor = anchor.view.camera
    objective = Objective.from_renders(view.render, anchor.render, reference, at_anchor, config)
    alone = make_renderer_alone(coarse, reference.camera, at_anchor, renderer, config)
    parameters = torch.zeros(
        (len(coarse), config.degrees_of_freedom), device=coarse.means.device, requires_grad=True
    )
    optimizer = Adam([(parameters, config.learning_rate)], ADAM_BETAS)
    losses = []
    for iteration in track(range(config.iterations), "Registering"):
        # The steps shrink to zero: few of them suffice, where the paper takes fifty equal ones
        # (decision 003).
        remaining = 1 - iteration / config.iterations
        moved = move_along_rays(coarse, parameters, reference.camera, config.degrees_of_freedom)
        loss = objective(*alone(moved))
        optimizer.step(loss, remaining)
        losses.append(loss.detach())
    with torch.no_grad():
        moved = move_along_rays(coarse, parameters, reference.camera, config.degrees_of_freedom)
    # Read together at the end: a GPU would have to finish each step before the next begins.
    return moved, tuple(torch.stack(losses).tolist())


def move_along_rays(
    coarse: Gaussians,
    parameters: Float[Tensor, "n dof"],
    camera: Camera,
    degrees_of_freedom: int = 1,
) -> Gaussians:
    """Move Gaussians along their target rays (Eq. 10), or freely with three degrees of freedom.

    A parameter is relative to the distance of its Gaussian, and not in scene units as in the paper:
    one learning rate then suits near and far Gaussians, and any unit of the scene.
    """
    distances = (coarse.means - camera.center).norm(dim=1, keepdim=True)
    shifts = distances * parameters  # in scene units, as in Eq. 10
    if degrees_of_freedom == 3:
        return replace(coarse, means=coarse.means + shifts, encoded=None)
    ratio = 1 + (shifts / distances)[:, 0]
    return slide(coarse, camera, ratio.clamp_min(MIN_RATIO), "constant")


def make_renderer_alone(
    coarse: Gaussians,
    target: Camera,
    anchor: Camera,
    renderer: Renderer,
    config: RegistrationConfig,
) -> RenderAlone:
    """Return a renderer of the moved Gaussians alone, at target and anchor.

    With a constant footprint their image at the target does not change along rays, so that a CPU
    only renders its depth again. A GPU is no faster by that: it draws for both cameras at once.
    """
    nothing = renderer.freeze(coarse[:0], target)
    if isinstance(nothing, JointScene):
        return lambda moved: nothing.composite_beside(moved, anchor)
    if config.degrees_of_freedom == 3:
        return lambda moved: (renderer.render(moved, target), renderer.render(moved, anchor))
    plan = nothing.vary_depths(coarse)
    return lambda moved: (
        plan(compute_z_depths(moved.means, target)),
        renderer.render(moved, anchor),
    )


@dataclass(frozen=True)
class Objective:
    """Loss `λ_d L_depth + λ_s L_stereo` (Eq. 11), as means over the image.

    L_rgb is missing: with a constant footprint the image does not depend on the distances.
    """

    target_depth: DepthMap
    """z-depth of the scene at the padded target, without the sky."""
    anchor_depth: DepthMap
    """The same at the anchor."""
    unit: Float[Tensor, ""]
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
        """Create the objective from renders of the scene at target and anchor.

        The sky is left out: it lies at a depth that we chose, and nothing measures it (decision
        016).
        """
        target_depth = mask_out_sky(at_target, reference.camera)
        anchor_depth = mask_out_sky(at_anchor, anchor)
        # Residuals are relative to the median depth, so that the unit of the scene does not matter.
        # Without any depth they are 0 anyway.
        seen = anchor_depth.depth.where(anchor_depth.valid, torch.nan)
        unit = seen.nanmedian().nan_to_num(1.0)
        return Objective(target_depth, anchor_depth, unit, config)

    def __call__(self, at_target: Render, at_anchor: Render) -> Float[Tensor, ""]:
        """Compute the loss from renders of the lifted Gaussians alone, at target and anchor.

        The paper renders L_depth of the composite scene, where a Gaussian behind a surface gets no
        gradient and stays there (decision 004).
        """
        l_depth = self.compute_depth_error(
            at_target, self.target_depth, self.target_depth.valid & at_target.depth_map().valid
        )
        l_stereo = self.compute_depth_error(
            at_anchor, self.anchor_depth, self.find_comparable(at_anchor)
        )
        return self.config.depth_weight * l_depth + self.config.stereo_weight * l_stereo

    def compute_depth_error(
        self, shown: Render, expected: DepthMap, where: Bool[Tensor, "h w"]
    ) -> Float[Tensor, ""]:
        """Compute the L1 depth error inside `where`, in `unit`, averaged over the image."""
        error = (shown.depth - expected.depth).abs() / self.unit
        return torch.where(where, error, 0.0).mean()

    def find_comparable(self, at_anchor: Render) -> Bool[Tensor, "h w"]:
        """Find anchor pixels that show the scene, and lifted Gaussians that it does not hide.

        The paper compares hidden ones too, which pulls them onto what hides them (decision 007).
        """
        seen = self.anchor_depth.valid & at_anchor.depth_map().valid
        limit = self.anchor_depth.depth * (1 + OCCLUSION_TOLERANCE)
        return seen & ~(at_anchor.depth.detach() > limit)
