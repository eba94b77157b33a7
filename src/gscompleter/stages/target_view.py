"""The scene as a target camera sees it, before anything is added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.config import HoleConfig
from gscompleter.numerics.geometry import is_same_camera, shrink_camera
from gscompleter.numerics.image_ops import blur_gaussian, dilate
from gscompleter.numerics.sky import mask_out_sky
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.protocols import FrozenScene
from gscompleter.render.removed import add_border, find_removed
from gscompleter.stages.enclosed_holes import keep_enclosed
from gscompleter.stages.error_budgets import share_budgets
from gscompleter.stages.select_anchor import AnchorChoice, compute_overlap, select_anchor
from gscompleter.state import Completion, TargetResult
from gscompleter.types import Camera, ErrorBudget, GeneratorInput, PaddedCamera, Render, View, merge

FULL_TRUST = 1.0
"""Mean trust of what a pixel shows from which on it is not recoloured."""
NO_TRUST = 0.6
"""Mean trust up to which a pixel takes the synthesized colour."""
DISTRUST_BLUR = 2 / 320
"""Standard deviation of the blur of that weight, relative to the longer side of the image."""

NOTHING_TO_COMPLETE = ": nothing to complete."
"""End of each sentence why a target is skipped that is not refused."""


@dataclass(frozen=True)
class TargetView:
    """The scene as the padded target camera sees it."""

    state: Completion
    scenes: SceneRenderer
    """Freezes the scene at further cameras, and remembers what it froze."""
    camera: PaddedCamera
    frozen: FrozenScene
    """The scene frozen at the padded camera."""
    alpha: Float[Tensor, "h w"]
    """Accumulated opacity at the padded camera, weighted by trust."""
    anchor: AnchorChoice

    @property
    def render(self) -> Render:
        """Render of the scene at the padded camera."""
        return self.frozen.render

    @cached_property
    def holes(self) -> Bool[Tensor, "h w"]:
        """Pixels that Φ fills: empty or not trusted."""
        return self.find_holes(self.alpha)

    @cached_property
    def empty(self) -> Bool[Tensor, "h w"]:
        """Hole mask M_hole of Eq. 12, before dilation: Gaussians are added here."""
        # Under full trust both are the same.
        return self.holes if self.alpha is self.render.alpha else self.find_holes(self.render.alpha)

    def find_holes(self, alpha: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
        """Decide what a hole is, given the accumulated opacity [h, w] that counts."""
        config = self.state.config.holes
        holes = compute_hole_mask(alpha, config)
        if config.padding == "beside":
            holes = holes & beside_holes(holes, self.camera, config.dilation)
        # Beside an object nothing is missing; nor is it where an object was taken away from there.
        if config.kind == "enclosed":
            holes = keep_enclosed(holes, self.render, self.camera.padded, self.render_at)
        # After a removal nothing else is completed, and counts as no hole.
        if self.opened is not None:
            holes = holes & self.opened
        return holes if self.forced is None else holes | self.forced

    @cached_property
    def forced(self) -> Bool[Tensor, "h w"] | None:
        """Pixels that are holes whatever stands there, as the user marked them; None without."""
        source = self.state.source
        if not self.state.config.holes.forces_removed or len(source.removed) == 0:
            return None
        forced = self.removed
        # What an earlier target filled is no hole any more.
        parts = self.state.added_parts
        filled = [part.gaussians for part in parts if part.origin.is_invented]
        if sum(map(len, filled)) == 0:
            return forced
        alpha = self.scenes.renderer.render(merge(filled), self.camera.padded).alpha
        return forced & compute_hole_mask(alpha, self.state.config.holes)

    @cached_property
    def opened(self) -> Bool[Tensor, "h w"] | None:
        """Pixels in which a removal may have opened a hole; None if all of them may be holes."""
        state = self.state
        if "removal" not in state.config.guards or len(state.source.removed) == 0:
            return None
        return add_border(self.removed)

    @property
    def removed(self) -> Bool[Tensor, "h w"]:
        """Pixels that showed something removed."""
        return find_removed(self.state.source, self.camera.padded, self.scenes.renderer)

    def render_at(self, camera: Camera) -> Render:
        """Render the same scene at another camera."""
        return self.scenes.freeze(self.state.parts, camera).render

    @cached_property
    def distrust(self) -> Float[Tensor, "h w"]:
        """Weight in [0, 1] with which covered pixels take the synthesized colour."""
        weight = compute_distrust(self.alpha, self.render.alpha)
        # Empty pixels get Gaussians of their own, and are no reason to recolour what is beside
        # them: they are left out before the blur, and again after it.
        # So is what is empty around an object, and is no hole.
        covered = ~self.empty & ~compute_hole_mask(self.render.alpha, self.state.config.holes)
        sigma = DISTRUST_BLUR * max(weight.shape)
        weight = blur_gaussian(weight.where(covered, 0.0), sigma)
        return weight.where(covered, 0.0)

    @property
    def candidate_mask(self) -> Bool[Tensor, "h w"] | None:
        """Pixels that are lifted: near empty pixels, or None for all of the pair (paper)."""
        radius = self.state.config.holes.candidate_radius
        return None if radius is None else dilate(self.empty, radius)

    @property
    def anchor_view(self) -> View:
        """Context view that forms the stereo pair with the target."""
        return self.state.views[self.anchor.index]

    @cached_property
    def view_renders(self) -> tuple[Render, ...]:
        """Renders of the scene at the context views."""
        return tuple(frozen.render for frozen in self.at(self.state.views))

    @cached_property
    def frozen_photos(self) -> tuple[FrozenScene, ...]:
        """The same scene frozen at all photographs."""
        return self.at([photo.view for photo in self.state.photos])

    @cached_property
    def budgets(self) -> tuple[tuple[ErrorBudget, ...], ...]:
        """Largest errors of each photograph that additions for this target may cause."""
        guard = self.state.config.psnr_guard
        return tuple(
            share_budgets(photo.budgets, frozen.render.image, guard)
            for photo, frozen in zip(self.state.photos, self.frozen_photos, strict=True)
        )

    @property
    def anchor_render(self) -> Render:
        """Render of the scene at the anchor."""
        return self.view_renders[self.anchor.index]

    def at(self, views: Sequence[View]) -> tuple[FrozenScene, ...]:
        """Freeze the same scene at photographs."""
        return self.scenes.freeze_at(self.state.parts, [view.camera for view in views])

    @cached_property
    def refusal(self) -> str | None:
        """Sentence why the target cannot be completed, or None if it can."""
        # The sky is no surface that anything could be registered to.
        before = self.render.crop(self.camera)
        covered = mask_out_sky(before, self.camera.target).valid.float().mean().item()
        return explain_little_covered(covered, self.state.config.holes)

    @property
    def skip_reason(self) -> str:
        """Sentence why there is nothing to complete; empty if there is."""
        if self.refusal:
            return self.refusal
        unsure = self.camera.crop(self.holes | (self.distrust > 0))
        # At a context view, which of a splat alone is a render, Φ could only return its image. That
        # is no reason where its pixels are ignored, since nothing is known of them.
        target = self.camera.target
        same = [view for view in self.state.views if is_same_camera(target, view.camera)]
        if any(not (unsure & ~view.valid_mask).any() for view in same):
            return f"The scene is known at this camera already{NOTHING_TO_COMPLETE}"
        if not unsure.any():
            return f"The target sees no hole of the scene{NOTHING_TO_COMPLETE}"
        return ""

    def make_unchanged_result(self) -> TargetResult:
        """Return the result of a target at which nothing was changed."""
        before = self.render.crop(self.camera)
        return TargetResult(
            target=self.camera.target,
            before=before,
            after=before,
            hole_mask=self.camera.crop(self.holes),
            trusted_alpha=self.camera.crop(self.alpha),
            anchor=self.anchor.index,
            anchor_fallback=self.anchor.fallback,
            added=self.state.rendered_context[:0],
            refusal=self.refusal,
            skip_reason=self.skip_reason,
            target_id=self.state.next_target_id,
        )

    def make_generator_input(self) -> GeneratorInput:
        """Collect the input of Φ, whose holes are those of this view."""
        config = self.state.config.holes
        render = self.render
        alpha = self.alpha
        # Φ takes as holes what has too little alpha, which is more than the holes of an object, or
        # those of a removal.
        if config.kind == "enclosed" or self.opened is not None:
            alpha = alpha.where(self.holes, 1.0)
        # What stands in a forced hole is wrong, so that Φ must not see it.
        if self.forced is not None:
            alpha = alpha.where(~self.forced, 0.0)
            shown = ~self.forced
            render = Render(
                render.image * shown[..., None], render.depth * shown, render.alpha * shown
            )
        return GeneratorInput(self.state.views, self.view_renders, render, config.max_alpha, alpha)


def compute_distrust(
    trusted_alpha: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """Compute a weight in [0, 1] that falls with the mean trust of what a pixel shows."""
    trust = trusted_alpha / alpha.clamp_min(1e-6)
    return ((FULL_TRUST - trust) / (FULL_TRUST - NO_TRUST)).clamp(0, 1)


def explain_little_covered(covered: float, config: HoleConfig = HoleConfig()) -> str | None:
    """Explain that too small a share of a target's image is covered; None if it is enough."""
    if covered >= config.min_covered:
        return None
    return (
        f"The target sees surfaces of the scene in {covered:.1%} of its image, and at least "
        f"{config.min_covered:.0%} are needed; move it closer to the photographs, or turn it "
        "towards what they show."
    )


def compute_hole_mask(
    alpha: Float[Tensor, "h w"], config: HoleConfig = HoleConfig()
) -> Bool[Tensor, "h w"]:
    """Return True where alpha is below the threshold, before dilation (paper, Eq. 12)."""
    return alpha < config.max_alpha


def beside_holes(
    holes: Bool[Tensor, "wide_h wide_w"], camera: PaddedCamera, dilation: int
) -> Bool[Tensor, "wide_h wide_w"]:
    """Mark the image of the target, and its padding beside holes that reach the border.

    What is not beside them was not asked for: one pixel of a hole at the border would open all of
    the padding. `dilation` in pixels is that of the hole mask.
    """
    inside = dilate(camera.crop(holes), dilation)[None, None].float()
    sides = (camera.left, camera.left, camera.top, camera.top)
    continued = pad(inside, sides, mode="replicate")[0, 0] > 0
    camera.crop(continued).fill_(True)
    return continued


def render_target(state: Completion, camera: PaddedCamera, scenes: SceneRenderer) -> TargetView:
    """Render the scene at a padded target and select its stereo anchor."""
    frozen = scenes.freeze(state.parts, camera.padded)
    alpha = state.trust.compute_alpha(frozen, camera.padded)
    anchor = choose_anchor(state, camera.target, scenes)
    return TargetView(state, scenes, camera, frozen, alpha, anchor)


def choose_anchor(state: Completion, target: Camera, scenes: SceneRenderer) -> AnchorChoice:
    """Select the anchor by rotation, baseline and, beyond the paper, overlap in small images."""
    config = state.config.anchor
    views = state.views
    if config.min_overlap == 0:
        return select_anchor(target, views, config)

    side = state.config.next_best_view.image_size
    small_target = shrink_camera(target, side)
    small_views = [shrink_camera(view.camera, side) for view in views]
    at_target, *at_views = scenes.freeze_small(state.parts, [small_target, *small_views])
    overlaps = [
        compute_overlap(small_target, at_target.render, camera, frozen.render)
        for camera, frozen in zip(small_views, at_views, strict=True)
    ]
    return select_anchor(target, views, config, overlaps)
