"""The scene as a target camera sees it, before anything is added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import measure_distances
from gscompleter.numerics.image_ops import blur_gaussian, dilate
from gscompleter.numerics.sky import mask_out_sky
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.protocols import FrozenScene
from gscompleter.render.removed import add_border, find_removed
from gscompleter.stages.error_budgets import share_budgets
from gscompleter.stages.hole_masks import (
    HoleEdits,
    HoleMasks,
    compute_hole_mask,
    find_hole_masks,
)
from gscompleter.state import Completion
from gscompleter.types import Camera, DepthMap, ErrorBudget, PaddedCamera, Render, View, merge

MAX_COMPLETED = 4
"""Most completed targets that are looked at: of long paths those nearest."""
FULL_TRUST = 1.0
"""Mean trust of what a pixel shows at which it keeps its colour."""
NO_TRUST = 0.6
"""Mean trust up to which a pixel takes the synthesized colour alone; above, it is mixed."""
DISTRUST_BLUR = 2 / 320
"""Standard deviation of the blur of the weight of synthesized colours, relative to the longer side
of the padded image: no seam where trust ends."""


@dataclass(frozen=True)
class TargetView:
    """The scene as the padded target camera sees it; h and w are those of the padded image."""

    state: Completion
    """The scene so far, with its photographs and settings."""
    scenes: SceneRenderer
    """Freezes the scene at further cameras, and remembers what it froze."""
    camera: PaddedCamera
    """The target, and the same camera with padding around its image."""
    frozen: FrozenScene
    """The scene frozen at the padded camera."""
    alpha: Float[Tensor, "h w"]
    """Accumulated opacity at the padded camera, weighted by trust, in [0, 1]."""
    masks: HoleMasks
    """The holes at the padded camera."""

    @property
    def render(self) -> Render:
        """Render of the scene at the padded camera."""
        return self.frozen.render

    @cached_property
    def depth(self) -> DepthMap:
        """z-depth of the render, D_ctx^tgt of the paper if nothing is padded."""
        return self.render.depth_map()

    @cached_property
    def surfaces(self) -> DepthMap:
        """z-depth of the render, valid on surfaces: not in the sky, whose depth is our choice."""
        return mask_out_sky(self.render, self.camera.padded)

    @property
    def holes(self) -> Bool[Tensor, "h w"]:
        """Pixels that Φ fills: empty or not trusted."""
        return self.masks.holes

    @property
    def empty(self) -> Bool[Tensor, "h w"]:
        """Hole mask M_hole of Eq. 12, before dilation: Gaussians are added here."""
        return self.masks.empty

    @cached_property
    def distrust(self) -> Float[Tensor, "h w"]:
        """Weight in [0, 1] with which covered pixels take the synthesized colour; 0 elsewhere."""
        weight = compute_distrust(self.alpha, self.render.alpha)
        # Empty pixels get Gaussians of their own, and are no reason to recolour what is beside
        # them: they are left out before the blur, and again after it. Beside `empty` that holds for
        # what is empty around an object, which is no hole.
        covered = ~self.empty & ~compute_hole_mask(self.render.alpha, self.state.config.holes)
        sigma = DISTRUST_BLUR * max(weight.shape)
        weight = blur_gaussian(weight.where(covered, 0.0), sigma)
        return weight.where(covered, 0.0)

    @cached_property
    def addition_mask(self) -> Bool[Tensor, "h w"]:
        """Pixels of the target in which additions are kept: empty ones and those beside them.

        Beyond Eq. 12 the hole mask is dilated, since a hard border leaves seams (decision 037).
        """
        return dilate(self.empty, self.state.config.holes.dilation)

    @property
    def candidate_mask(self) -> Bool[Tensor, "h w"] | None:
        """Pixels of the target that are lifted: empty ones and what is near them.

        None for all pixels of target and anchor, as in the paper.
        """
        radius = self.state.config.holes.candidate_radius
        return None if radius is None else dilate(self.empty, radius)

    @cached_property
    def view_renders(self) -> tuple[Render, ...]:
        """Renders of the scene at the context views."""
        return tuple(frozen.render for frozen in self.freeze_views(self.state.views))

    @cached_property
    def frozen_photos(self) -> tuple[FrozenScene, ...]:
        """The scene frozen at all photographs: the context, then the check views."""
        return self.freeze_views([photo.view for photo in self.state.photos])

    @cached_property
    def budgets(self) -> tuple[tuple[ErrorBudget, ...], ...]:
        """Largest errors of each of `frozen_photos` that additions for this target may cause.

        That is the share of this target in the budgets for all targets.
        """
        guard = self.state.config.psnr_guard
        return tuple(
            share_budgets(photo.budgets, frozen.render.image, guard)
            for photo, frozen in zip(self.state.photos, self.frozen_photos, strict=True)
        )

    @cached_property
    def completed_cameras(self) -> list[Camera]:
        """Cameras of the completed targets nearest to this one.

        Where gaps are closed, the target that they are beside is one of them.
        """
        cameras = self.state.completed_cameras
        if self.state.filled_target is not None:
            cameras = [*cameras, self.state.filled_target]
        if not cameras:
            return []
        order = measure_distances(cameras, [self.camera.target]).argsort(stable=True)
        return [cameras[index] for index in order[:MAX_COMPLETED].tolist()]

    @cached_property
    def frozen_completed(self) -> tuple[FrozenScene, ...]:
        """The scene frozen at each of `completed_cameras`."""
        return self.scenes.freeze_at(self.state.parts, self.completed_cameras)

    def freeze_views(self, views: Sequence[View]) -> tuple[FrozenScene, ...]:
        """Freeze the scene at the cameras of views."""
        return self.scenes.freeze_at(self.state.parts, [view.camera for view in views])


def compute_distrust(
    trusted_alpha: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """Compute the weight of synthesized colours, in [0, 1].

    It falls from 1 to 0 as the mean trust of what a pixel shows, which is the ratio of both alphas,
    rises from `NO_TRUST` to `FULL_TRUST`. Where nothing is shown it means nothing.
    """
    trust = trusted_alpha / alpha.clamp_min(1e-6)
    return ((FULL_TRUST - trust) / (FULL_TRUST - NO_TRUST)).clamp(0, 1)


def render_target(state: Completion, camera: PaddedCamera, scenes: SceneRenderer) -> TargetView:
    """Render the scene at a padded target, and find its holes before anything is added for it."""

    def render_at(other: Camera) -> Render:
        return scenes.freeze(state.parts, other).render

    frozen = scenes.freeze(state.parts, camera.padded)
    alpha = state.trust.compute_alpha(frozen, camera.padded)
    edits = find_hole_edits(state, camera, frozen, scenes)
    masks = find_hole_masks(frozen.render, alpha, camera, state.config.holes, edits, render_at)
    return TargetView(state, scenes, camera, frozen, alpha, masks)


def find_hole_edits(
    state: Completion, camera: PaddedCamera, frozen: FrozenScene, scenes: SceneRenderer
) -> HoleEdits:
    """Find where a removal may have opened holes, and where the user marked the scene as wrong.

    Both are masks of the padded image. `frozen` is the scene at the padded camera.
    """
    config = state.config
    if len(state.source.removed) == 0:
        return HoleEdits()
    if not (config.completes_removals_only or config.holes.forces_removed):
        return HoleEdits()
    confirmed = mark_confirmed(state, camera, frozen)
    removed = find_removed(state.source, camera.padded, scenes.renderer)
    opened = add_border(removed) if config.completes_removals_only else None
    if not config.holes.forces_removed:
        return HoleEdits(opened)
    # What an earlier target filled is no hole any more.
    filled = [part.gaussians for part in state.added_parts if part.origin.is_invented]
    if sum(map(len, filled)) > 0:
        filled_alpha = scenes.renderer.render(merge(filled), camera.padded).alpha
        removed = removed & compute_hole_mask(filled_alpha, config.holes)
    # A surface that photographs confirm shows the place as it is: there is nothing to fill.
    return HoleEdits(opened, removed if confirmed is None else removed & ~confirmed)


def mark_confirmed(
    state: Completion, camera: PaddedCamera, frozen: FrozenScene
) -> Bool[Tensor, "h w"] | None:
    """Mark the pixels that show a surface which photographs confirm after a removal.

    None if photographs do not decide what stays.
    """
    if state.confirmation is None:
        return None
    is_covered = ~compute_hole_mask(frozen.render.alpha, state.config.holes)
    confirmed_alpha = state.confirmation.compute_alpha(frozen, camera.padded)
    return is_covered & (confirmed_alpha >= COVERED)
