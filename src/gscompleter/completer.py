"""GSCompleter: generate, then register, for one target after the other."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from gscompleter.config import CompleterConfig
from gscompleter.config.settings import validate
from gscompleter.deprecation import accept_old_keywords
from gscompleter.errors import InputError
from gscompleter.generators import Generator, ImageFunction, as_generator, load_generator
from gscompleter.geometry import (
    is_same_camera,
    pad_camera,
    pad_like,
    pad_pixels,
    project,
    sample,
    shrink_camera,
    slide,
)
from gscompleter.guards.dynamic_masks import find_dynamic_masks
from gscompleter.guards.free_space import respect_free_space
from gscompleter.guards.mvs_hint import StereoRender, apply_stereo, render_stereo
from gscompleter.guards.prune_occluders import find_unneeded
from gscompleter.guards.psnr import meet_error_budgets, set_error_budgets
from gscompleter.image_ops import dilate, is_enclosed
from gscompleter.progress import stage, track
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.render import (
    FrozenScene,
    Renderer,
    get_view_map,
    load_renderer,
    restrict_to_image,
)
from gscompleter.render.antialiasing import adapt_to_mode
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, build_proxy, thin_gaussians
from gscompleter.sky import mask_out_sky
from gscompleter.stages.align_depth import sample_depth_pairs
from gscompleter.stages.context import (
    check_texture,
    find_depth_range,
    init_context,
    normalize_exposures,
    sort_by_frame,
)
from gscompleter.stages.filter_holes import compute_hole_mask, filter_holes
from gscompleter.stages.frozen_views import SceneRenderer
from gscompleter.stages.refine import refine_opacities
from gscompleter.stages.select_anchor import (
    AnchorChoice,
    GeneratedView,
    compute_overlap,
    lift,
    select_anchor,
    synthesize_all,
)
from gscompleter.stages.slide_along_rays import Registration, register
from gscompleter.state import Completion, InitialContext, TargetResult
from gscompleter.trust.photometric import (
    compute_front_depth,
    compute_observed_fraction,
    compute_trust,
    compute_trusted_alpha,
    gather_observations,
    sum_weights,
)
from gscompleter.types import (
    Camera,
    DepthAffine,
    Gaussians,
    GeneratorInput,
    Lift,
    PaddedCamera,
    PhotoObservations,
    Render,
    View,
    merge,
)

MAX_TARGET_ID = 255
"""Largest target id: `generated` is one byte per Gaussian, and 0 means observed."""

MIN_OBSERVED_FRACTION = 0.1
"""Fraction of a Gaussian's visible area below which a photograph does not observe it."""
COLOR_TOLERANCE = 0.01
"""Largest tolerated excess of a colour beyond [0, 1], as resampling causes it."""
MIN_HOLE_PIXELS = 0.5
"""Hole pixels that a Gaussian has to cover to count as an occluder."""

MADE_WORSE = "Most of the Gaussians that were generated here make photographs worse."
NOTHING_ADDED = "Nothing of it was added."

STAGES = ("context", "generate", "lift", "register", "integrate")
"""Stages whose wall time is recorded."""


@dataclass(frozen=True)
class TargetView:
    """The scene as the padded target camera sees it, before anything is added."""

    completion: Completion
    camera: PaddedCamera
    frozen: FrozenScene
    """The scene frozen at the padded camera."""
    anchor: AnchorChoice
    trusted_alpha: Float[Tensor, "h w"] | None = None
    """Alpha at the padded camera weighted by trust, or None under full trust."""
    stereo: StereoRender | None = None
    """MVS render of the photographs at the padded camera, or None if not computed."""

    @property
    def alpha(self) -> Float[Tensor, "h w"]:
        """Alpha that the hole mask thresholds, at the padded camera."""
        return self.frozen.render.alpha if self.trusted_alpha is None else self.trusted_alpha

    @property
    def target_render(self) -> Render:
        """Render of the scene at the target, without padding."""
        return self.frozen.render.crop(self.camera)

    @property
    def anchor_view(self) -> View:
        """Context view that forms the stereo pair with the target."""
        return self.completion.views[self.anchor.index]


@dataclass(frozen=True)
class GSCompleter:
    """Completes 3DGS scenes for target cameras: generate, then register.

    The default models need neither weights nor a GPU.
    """

    reconstructor: Reconstructor = field(default_factory=lambda: load_reconstructor("plane-sweep"))
    """Ψ: views -> Gaussians and depth maps."""
    generator: Generator | ImageFunction = field(
        default_factory=lambda: load_generator("warp-inpaint")
    )
    """Φ: nearest view and target camera -> image."""
    renderer: Renderer = field(default_factory=lambda: load_renderer("cpu"))
    """Differentiable renderer of Gaussians."""
    config: CompleterConfig = CompleterConfig()
    """Settings of the stages."""
    seed: int = 0
    """Seed of the RANSAC samples."""
    keep_registered: bool = False
    """True to keep all registered Gaussians in each result, for evaluation."""

    def __post_init__(self) -> None:
        """Raise InputError if a setting is out of range."""
        validate(self.config, "config.")

    @cached_property
    def scenes(self) -> SceneRenderer:
        """The current scene, frozen at the cameras of its photographs."""
        return SceneRenderer(self.renderer)

    @cached_property
    def small_scenes(self) -> SceneRenderer:
        """A simplified version of the current scene, frozen at the cameras of small images."""
        return SceneRenderer(
            self.renderer, partial(thin_gaussians, max_gaussians=MAX_PREVIEW_GAUSSIANS)
        )

    @accept_old_keywords(witnesses="check_views")
    def __call__(
        self,
        views: Sequence[View],
        target: Camera | Sequence[Camera],
        scene: Gaussians | None = None,
        check_views: Sequence[View] | None = None,
    ) -> Completion:
        """Complete what `views` never saw, as seen from one or several targets.

        Args:
            views: Posed context views: at least two, or one if `scene` is given. Views with frame
                numbers are sorted by them.
            target: Target cameras, completed one after the other into one scene.
            scene: Gaussians to complete, in the frame and unit of the cameras. They are kept bit
                for bit. If None, Ψ reconstructs the context from `views`.
            check_views: Further photographs of `scene` that must not get worse. With them the scene
                is trusted only as far as the photographs confirm it, and occluders are pruned.

        Raises:
            InputError: Too few views, no baseline, too many targets, no view sees the scene, or no
                target sees enough of it.
        """
        targets = [target] if isinstance(target, Camera) else list(target)
        if not targets:
            raise InputError("No target camera was given; name at least one view to complete.")
        check_target_ids(scene, len(targets))
        completion = self.begin(views, scene, check_views, targets)
        batch_size = as_generator(self.generator).max_batch_size
        counted_as = "target" if batch_size == 1 else "group of targets"
        for start in track(range(0, len(targets), batch_size), counted_as):
            completion = self.advance_batch(completion, targets[start : start + batch_size])
        check_any_completed(completion)
        return completion

    @accept_old_keywords(witnesses="check_views")
    def begin(
        self,
        views: Sequence[View],
        scene: Gaussians | None = None,
        check_views: Sequence[View] | None = None,
        targets: Sequence[Camera] = (),
    ) -> Completion:
        """Initialize the context (stage 1).

        Args:
            views: As in `__call__`.
            scene: As in `__call__`.
            check_views: As in `__call__`.
            targets: Targets that are known already. The LOD proxy of a large scene is made fine
                enough for them and the photographs.

        Raises:
            InputError: Too few views, no baseline, or no view sees the scene.
        """
        if len(views) < (2 if scene is None else 1):
            raise InputError(
                f"{len(views)} context view was given, and stereo needs at least 2; name more "
                "frames, or give a scene."
            )
        views = sort_by_frame(views)
        check_values([*views, *(check_views or ())], scene)
        if scene is None:
            return self.begin_with(self.reconstruct(views))
        clock = Clock()
        with clock("context"):
            cameras = [*targets, *(view.camera for view in (*views, *(check_views or ())))]
            proxy = build_proxy(scene, cameras)
            rendered = scene if proxy is None else proxy.scene
            near, far = find_depth_range(views, rendered, self.renderer)
            views = tuple(set_depth_range(view, near, far) for view in views)
            others = tuple(set_depth_range(view, near, far) for view in check_views or ())
            completion = Completion(rendered, scene, views, (), (), {}, others, proxy=proxy)
            if check_views is not None and self.config.trust == "photometric":
                completion = self.add_observations(completion)
            completion = self.add_error_budgets(completion)
        return replace(completion, seconds=clock.seconds)

    def reconstruct(self, views: Sequence[View]) -> InitialContext:
        """Reconstruct the context from posed photographs (paper, Eq. 5)."""
        clock = Clock()
        with clock("context"):
            check_texture(views)
            near, far = find_depth_range(views, None, self.renderer)
            views = [set_depth_range(view, near, far) for view in views]
            gaussians, gains = init_context(self.reconstructor, views)
        return InitialContext(gaussians, normalize_exposures(views, gains), gains, clock.seconds)

    def begin_with(self, context: InitialContext) -> Completion:
        """Begin from a reconstructed context: compute dynamic masks and error budgets."""
        clock = Clock()
        with clock("context"):
            scene = context.gaussians
            completion = Completion(
                scene, scene, context.views, (), (), {}, exposure_gains=context.exposure_gains
            )
            completion = self.add_error_budgets(self.add_dynamic_masks(completion))
        return replace(completion, seconds=add_seconds(clock.seconds, context.seconds))

    def advance(
        self, completion: Completion, target: Camera, reference: GeneratedView | None = None
    ) -> Completion:
        """Complete the scene for one more target (stages 2 to 4).

        Args:
            completion: The scene so far; it is not changed.
            target: Camera to complete the scene for.
            reference: Image at the target, padded if Φ supports it, if it was synthesized in
                advance.

        Raises:
            InputError: The scene holds as many targets as a .ply can tell apart.
        """
        check_target_ids(completion.context, len(completion.targets) + 1)
        clock = Clock()
        with clock("context"):
            padded = None if reference is None else reference.camera
            target_view = self.observe(completion, target, padded)
        result = self.begin_result(target_view)
        reason = find_skip_reason(result, completion.views)
        if reason is not None:
            return append_result(completion, replace(result, notes=(reason,)), clock.seconds)
        with clock("context"):
            target_view = self.prune_occluders(target_view)
        result = self.complete_target(target_view, result, reference, clock)
        base = target_view.completion if len(result.added) else completion
        advanced = append_result(base, result, clock.seconds)
        for cache in (self.scenes, self.small_scenes):
            cache.accept_growth(base.rendered_scene, advanced.rendered_scene)
        return advanced

    def complete_target(
        self,
        target_view: TargetView,
        result: TargetResult,
        reference: GeneratedView | None,
        clock: Clock,
    ) -> TargetResult:
        """Run stages 2 to 4 for an observed target and fill in its result."""
        completion, target = target_view.completion, target_view.camera.target
        with clock("generate"):
            frozen_views = self.freeze_at(completion, completion.views)
            if reference is None:
                (reference,) = self.synthesize([target_view], get_renders(frozen_views))
        result = replace(result, reference=View(target_view.camera.crop(reference.image), target))
        if reference.is_inconsistent and self.config.psnr_guard.max_opacity_loss is not None:
            return replace(result, notes=(*reference.notes, NOTHING_ADDED))
        with clock("lift"):
            lifted = self.lift(target_view, reference)
        with clock("register"):
            registration = self.register(target_view, lifted, reference, frozen_views)
        at_anchor = frozen_views[target_view.anchor.index].render
        fit, settings = registration.affine, self.config.alignment
        pairs = sample_depth_pairs(lifted, target_view.frozen.render, at_anchor, fit, settings)
        everything = registration.gaussians if self.keep_registered else None
        result = replace(result, affine=fit, pairs=pairs, registered=everything)
        if registration.affine.is_rejected:
            notes = describe_fallbacks(target_view.anchor.fallback, registration.affine)
            return replace(result, notes=(*reference.notes, *notes, NOTHING_ADDED))
        with clock("integrate"):
            kept = self.filter_registered(target_view, lifted, registration, frozen_views)
            added, losses = self.refine(target_view, kept, reference)
            after = target_view.frozen.composite(added).crop(target_view.camera)
        return replace(
            result,
            after=after,
            added=added,
            losses={"register": registration.losses, "refine": losses},
            notes=(
                *reference.notes,
                *describe_fallbacks(target_view.anchor.fallback, registration.affine),
                *((MADE_WORSE, NOTHING_ADDED) if len(added) < len(kept) else ()),
            ),
        )

    def advance_batch(self, completion: Completion, targets: Sequence[Camera]) -> Completion:
        """Complete several targets, whose images Φ synthesizes in one call."""
        if len(targets) < 2:
            return reduce(self.advance, targets, completion)
        references, seconds = self.synthesize_references(completion, targets)
        completion = replace(completion, seconds=add_seconds(completion.seconds, seconds))
        for target, reference in zip(targets, references, strict=True):
            completion = self.advance(completion, target, reference)
        return completion

    def synthesize_reference(self, completion: Completion, target: Camera) -> View:
        """Synthesize the image at a target, without padding, even if there is no hole."""
        target_view = self.observe(completion, target)
        at_views = get_renders(self.freeze_at(completion, completion.views))
        (image,) = self.synthesize([target_view], at_views)
        return View(target_view.camera.crop(image.image), target_view.camera.target)

    def begin_result(self, target_view: TargetView) -> TargetResult:
        """Begin the result of a target; refuse the target if it sees too little of the scene."""
        result = make_unchanged_result(
            target_view, target_view.camera.crop(self.find_holes(target_view))
        )
        covered = mask_out_sky(result.before, result.target).valid.float().mean().item()
        least = self.config.holes.min_covered
        if covered >= least:
            return result
        reason = (
            f"The target sees surfaces of the scene in {covered:.1%} of its image, and at least "
            f"{least:.0%} are needed; move it closer to the photographs, or turn it towards what "
            "they show."
        )
        return replace(result, refusal=reason)

    def synthesize_references(
        self, completion: Completion, targets: Sequence[Camera]
    ) -> tuple[list[GeneratedView | None], Mapping[str, float]]:
        """Synthesize the images of all targets that have holes; also return the seconds."""
        clock = Clock()
        with clock("context"):
            target_views = [self.observe(completion, target) for target in targets]
            results = [self.begin_result(target_view) for target_view in target_views]
            has_hole = [find_skip_reason(result, completion.views) is None for result in results]
            at_views = get_renders(self.freeze_at(completion, completion.views))
        with clock("generate"):
            open_views = [
                target_view
                for target_view, needed in zip(target_views, has_hole, strict=True)
                if needed
            ]
            images = iter(self.synthesize(open_views, at_views))
        return [next(images) if needed else None for needed in has_hole], clock.seconds

    def synthesize(
        self, target_views: Sequence[TargetView], at_views: Sequence[Render]
    ) -> list[GeneratedView]:
        """Synthesize the image of each padded target (stage 2)."""
        inputs = [
            (target_view.camera.padded, self.make_generator_input(target_view, at_views))
            for target_view in target_views
        ]
        return synthesize_all(self.generator, inputs) if inputs else []

    def make_generator_input(
        self, target_view: TargetView, at_views: Sequence[Render]
    ) -> GeneratorInput:
        """Collect the input of Φ at a target."""
        synthesis = self.config.synthesis
        context = GeneratorInput(
            target_view.completion.views,
            tuple(at_views),
            target_view.frozen.render,
            self.config.holes.max_alpha,
            synthesis.correct_color,
            synthesis.source_depth,
            target_view.trusted_alpha,
        )
        return context if target_view.stereo is None else apply_stereo(context, target_view.stereo)

    def lift(self, target_view: TargetView, reference: GeneratedView) -> Lift:
        """Lift the pixels near holes to Gaussians in the antialiasing mode of the scene."""
        radius = self.config.holes.candidate_radius
        pixel_mask = None if radius is None else dilate(self.find_holes(target_view), radius)
        lifted = lift(self.reconstructor, reference, target_view.anchor_view, pixel_mask)
        scene, gaussians = target_view.completion.rendered_scene, lifted.gaussians
        return replace(lifted, gaussians=adapt_to_mode(scene, gaussians, reference.camera))

    def register(
        self,
        target_view: TargetView,
        lifted: Lift,
        reference: GeneratedView,
        frozen_views: Sequence[FrozenScene],
    ) -> Registration:
        """Register the lifted Gaussians to the scene (stage 3)."""
        return register(
            lifted,
            target_view.frozen,
            frozen_views[target_view.anchor.index].render,
            reference,
            target_view.anchor_view.camera,
            self.renderer,
            torch.Generator().manual_seed(self.seed),
            self.config.registration,
            self.config.holes.max_alpha,
            self.config.alignment,
            self.reject_below(target_view),
        )

    def reject_below(self, sight: TargetView) -> float | None:
        """Return the depth agreement that a target needs.

        With photometric trust it needs none: where the scene is wrong, right depths differ from it.
        """
        return self.config.depth_agreement.reject_below if sight.trusted_alpha is None else None

    def filter_registered(
        self,
        target_view: TargetView,
        lifted: Lift,
        registration: Registration,
        frozen_views: Sequence[FrozenScene],
    ) -> Gaussians:
        """Keep registered Gaussians in holes, outside of observed free space (stage 4)."""
        mask = dilate(self.find_holes(target_view), self.config.holes.dilation)
        padded, views = target_view.camera.padded, target_view.completion.views
        side, earlier = self.config.next_best_view.image_size, target_view.completion.targets
        completed_cameras = [result.target for result in earlier if len(result.added)]
        small_cameras = [
            shrink_camera(camera, side)
            for camera in (*target_view.completion.free_space_cameras, *completed_cameras)
        ]
        kept, is_placed = respect_free_space(
            self.place_in_front(
                filter_holes(registration.gaussians, lifted.pixel_index, mask, padded), target_view
            ),
            padded,
            [*(view.camera for view in views), *small_cameras],
            [
                *(
                    self.apply_trust(target_view, f, v)
                    for f, v in zip(frozen_views, views, strict=True)
                ),
                *self.render_small(target_view.completion, small_cameras),
            ],
            self.config.registration.footprint,
            self.config.free_space,
        )
        kept = kept[is_placed]
        number = torch.full_like(kept.generated, target_view.completion.next_target_id)
        return replace(kept, generated=number)

    def apply_trust(self, target_view: TargetView, frozen: FrozenScene, view: View) -> Render:
        """Weight the alpha of a photograph's render by trust."""
        render = frozen.render
        alpha = self.compute_trusted_alpha(target_view.completion, frozen, view.camera)
        return render if alpha is None else replace(render, alpha=alpha)

    def place_in_front(self, kept: Gaussians, target_view: TargetView) -> Gaussians:
        """Move Gaussians in front of untrusted Gaussians that were not pruned."""
        if target_view.trusted_alpha is None or len(kept) == 0:
            return kept
        camera, scene = target_view.camera.padded, target_view.completion.rendered_scene
        nearest = compute_front_depth(scene, target_view.frozen, camera)
        pixels, z = project(kept.means, camera)
        limit = sample(nearest[..., None], pixels, "nearest")[:, 0]
        covered = sample(target_view.frozen.render.alpha[..., None], pixels, "nearest")[:, 0] > 0.1
        ratio = torch.where(covered & (limit > 0), (limit / z).clamp_max(1.0), 1.0)
        return slide(kept, camera, ratio, self.config.registration.footprint)

    def refine(
        self, target_view: TargetView, kept: Gaussians, reference: GeneratedView
    ) -> tuple[Gaussians, tuple[float, ...]]:
        """Refine new Gaussians and fade those that harm photographs (stage 4)."""
        completion, config = target_view.completion, self.config
        budgets = completion.budgets
        frozen = self.freeze_at(completion, completion.photos)
        nearest = sort_by_distance(reference.camera, completion.views)[: config.refine.num_views]
        planned = [view.vary_opacities(kept) for view in frozen]
        refined, losses = refine_opacities(
            kept,
            target_view.frozen.vary_opacities(kept),
            reference,
            [planned[i] for i in nearest],
            [completion.views[i] for i in nearest],
            config.refine,
        )
        images = [restrict_to_image(plan) for plan in planned]
        return meet_error_budgets(refined, frozen, budgets, config.psnr_guard, images), losses

    def observe(
        self, completion: Completion, target: Camera, padded: Camera | None = None
    ) -> TargetView:
        """Render the scene at a target, padded if a hole reaches the border.

        A reference that was synthesized in advance determines the padding by its camera, `padded`.
        """
        camera = self.pad_target(completion, target)
        if padded is not None:
            camera = pad_like(camera.target, padded)
        target_view = self.render_target(completion, camera)
        if padded is None and is_enclosed(camera.crop(self.find_holes(target_view))):
            target_view = self.render_target(completion, pad_pixels(camera.target, 0, 0))
        found = self.render_stereo_hint(completion, target_view.frozen.render, target_view.camera)
        return replace(target_view, stereo=found)

    def render_target(self, completion: Completion, camera: PaddedCamera) -> TargetView:
        """Render the scene at a padded target, without stereo among the photographs."""
        frozen = self.renderer.freeze(completion.rendered_scene, camera.padded)
        anchor = self.choose_anchor(completion, camera.target)
        return TargetView(
            completion,
            camera,
            frozen,
            anchor,
            self.compute_trusted_alpha(completion, frozen, camera.padded),
        )

    def choose_anchor(self, completion: Completion, target: Camera) -> AnchorChoice:
        """Select the stereo anchor of a target."""
        config, views = self.config.anchor, completion.views
        if config.min_overlap == 0:
            return select_anchor(target, views, config)
        cameras = [
            shrink_camera(c, self.config.next_best_view.image_size)
            for c in (target, *(view.camera for view in views))
        ]
        seen, *at_views = self.render_small(completion, cameras)
        overlaps = [
            compute_overlap(cameras[0], seen, camera, render)
            for camera, render in zip(cameras[1:], at_views, strict=True)
        ]
        return select_anchor(target, views, config, overlaps)

    def render_stereo_hint(
        self, completion: Completion, render: Render, camera: PaddedCamera
    ) -> StereoRender | None:
        """Render stereo among the photographs at the padded target; None under full trust."""
        cameras = [view.camera for view in completion.views]
        if completion.observations is None or any(
            is_same_camera(camera.target, c) for c in cameras
        ):
            return None
        return render_stereo(
            completion.views,
            camera.padded,
            render,
            self.reconstructor,
            self.renderer,
            self.config.trust_settings,
        )

    def compute_trusted_alpha(
        self, completion: Completion, frozen: FrozenScene, camera: Camera
    ) -> Float[Tensor, "h w"] | None:
        """Compute alpha weighted by trust at a camera; None under full trust."""
        if completion.observations is None:
            return None
        values = self.compute_trust(completion, completion.observations, frozen, camera)
        return compute_trusted_alpha(frozen, values)

    def compute_trust(
        self,
        completion: Completion,
        observations: PhotoObservations,
        frozen: FrozenScene,
        camera: Camera,
    ) -> Float[Tensor, "n"]:
        """Compute the trust of every rendered Gaussian; generated and invisible ones have 1."""
        sums, kept = sum_weights(frozen), completion.num_kept
        seen = expand_to_context(completion, sums[:kept])
        trust = compute_trust(observations, seen, camera, self.config.trust_settings)
        values = torch.ones_like(sums)
        values[:kept] = select_kept(completion, trust)
        return values

    def add_observations(self, completion: Completion) -> Completion:
        """Add the photographs' observations of an input splat, before any target."""
        views, scene = completion.photos, completion.rendered_scene
        frozen_views = self.freeze_at(completion, views)
        observations = gather_observations(scene, views, frozen_views, self.config.trust_settings)
        return replace(completion, observations=observations)

    def prune_occluders(self, target_view: TargetView) -> TargetView:
        """Prune occluders: unobserved Gaussians that cover holes and that no photograph needs.

        Without check views nothing is pruned, as other photographs may show those Gaussians.
        """
        completion, config = target_view.completion, self.config.trust_settings
        if completion.observations is None or not completion.check_views or not config.prune:
            return target_view
        occluders = self.find_occluders(target_view, completion.observations)
        if not occluders.any():
            return target_view
        removable = self.find_unneeded(completion, occluders)
        if not removable.any():
            return target_view
        pruned_view = self.render_target(prune(completion, removable), target_view.camera)
        # Stereo depends on the photographs only, which do not change.
        return replace(pruned_view, stereo=target_view.stereo)

    def find_unneeded(
        self, completion: Completion, occluders: Bool[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Find those of the given Gaussians that can be removed without harm to any photograph."""
        views, rest = completion.photos, completion.rendered_scene[~occluders]
        cameras = [view.camera for view in views]
        around = get_view_map(rest)(partial(self.renderer.freeze, rest), cameras)
        self.scenes.clear()  # Free memory: the next scene lacks `doubtful`.
        removable = find_unneeded(completion.rendered_scene[occluders], around, views)
        return occluders.masked_scatter(occluders, removable)

    def find_occluders(
        self, target_view: TargetView, observations: PhotoObservations
    ) -> Bool[Tensor, "n"]:
        """Find context Gaussians that cover holes and that no photograph shows."""
        completion, camera = target_view.completion, target_view.camera.padded
        scene, holes = completion.rendered_scene, self.find_holes(target_view)
        everywhere = torch.ones_like(target_view.alpha)
        layers = torch.stack([everywhere, holes.to(everywhere), 0 * everywhere], dim=-1)
        sums, covering, _ = target_view.frozen.backproject(layers).unbind(-1)
        is_occluder = (covering > MIN_HOLE_PIXELS) & (scene.generated == 0)
        kept = completion.num_kept
        seen = compute_observed_fraction(
            observations, expand_to_context(completion, sums[:kept]), camera
        )
        is_occluder[:kept] &= select_kept(completion, seen) < MIN_OBSERVED_FRACTION
        is_occluder[kept:] = False
        return is_occluder

    def pad_target(self, completion: Completion, target: Camera) -> PaddedCamera:
        """Pad a target camera by as much as the settings and Φ allow."""
        supports_padding = as_generator(self.generator).supports_padding
        return pad_camera(
            completion.with_depth_range(target), self.config.margin if supports_padding else 0.0
        )

    def find_holes(self, target_view: TargetView) -> Bool[Tensor, "h w"]:
        """Compute the hole mask at the padded camera."""
        return compute_hole_mask(target_view.alpha, self.config.holes)

    def add_dynamic_masks(self, completion: Completion) -> Completion:
        """Add dynamic masks to the context views."""
        views, renders = completion.views, get_renders(self.freeze_at(completion, completion.views))
        masks = find_dynamic_masks(views, renders, self.config.dynamic_masks)
        return replace(
            completion,
            views=tuple(
                replace(view, dynamic_mask=mask if mask.any() else None)
                for view, mask in zip(views, masks, strict=True)
            ),
        )

    def add_error_budgets(self, completion: Completion) -> Completion:
        """Add the error budgets of all photographs, before any target."""
        config = self.config.psnr_guard
        tolerance = 0.0 if completion.observations is not None else config.max_drop or 0.0
        renders = get_renders(self.freeze_at(completion, completion.photos))
        budgets = tuple(
            set_error_budgets(
                view,
                render.image,
                compute_hole_mask(render.alpha, self.config.holes),
                tolerance,
                config.max_ssim_drop,
            )
            for view, render in zip(completion.photos, renders, strict=True)
        )
        return replace(
            completion, budgets=budgets, context_renders=renders[: len(completion.views)]
        )

    def freeze_at(self, completion: Completion, views: Sequence[View]) -> tuple[FrozenScene, ...]:
        """Freeze the scene at the cameras of photographs."""
        return self.scenes.freeze_at(completion, [view.camera for view in views])

    def render_small(self, completion: Completion, cameras: Sequence[Camera]) -> Sequence[Render]:
        """Render a simplified scene at cameras of small images."""
        return get_renders(self.small_scenes.freeze_at(completion, cameras))


def set_depth_range(view: View, near: float, far: float) -> View:
    """Return the view with a depth range in scene units."""
    return replace(view, camera=replace(view.camera, near=near, far=far))


def prune(completion: Completion, removable: Bool[Tensor, "n"]) -> Completion:
    """Prune rendered Gaussians of the context."""
    before, new = completion.pruned, expand_to_context(completion, removable[: completion.num_kept])
    pruned = new if before is None else before | new
    return replace(completion, rendered_scene=completion.rendered_scene[~removable], pruned=pruned)


def expand_to_context(
    completion: Completion, values: Shaped[Tensor, "kept"]
) -> Shaped[Tensor, "m"]:
    """Map values of kept context Gaussians to all rendered ones; pruned ones get 0."""
    pruned = completion.pruned
    if pruned is None:
        return values
    return values.new_zeros(len(pruned)).masked_scatter(~pruned, values)


def select_kept(completion: Completion, values: Shaped[Tensor, "m"]) -> Shaped[Tensor, "kept"]:
    """Select the values of context Gaussians that are not pruned."""
    pruned = completion.pruned
    return values if pruned is None else values[~pruned]


def check_target_ids(scene: Gaussians | None, num_targets: int) -> None:
    """Raise InputError if `generated` cannot hold the ids of `num_targets` more targets."""
    given = 0 if scene is None or len(scene) == 0 else int(scene.generated.max())
    if given + num_targets > MAX_TARGET_ID:
        raise InputError(
            f"{num_targets} targets were given after {given} in the scene, and a .ply can tell "
            f"{MAX_TARGET_ID} apart; complete the scene in several runs."
        )


def make_unchanged_result(target_view: TargetView, holes: Bool[Tensor, "h w"]) -> TargetResult:
    """Return the result of a target to which nothing was added."""
    return TargetResult(
        target=target_view.camera.target,
        before=target_view.target_render,
        after=target_view.target_render,
        hole_mask=holes,
        reference=None,
        anchor=target_view.anchor.index,
        anchor_fallback=target_view.anchor.fallback,
        affine=DepthAffine(),
        added=target_view.completion.rendered_scene[:0],
        trusted_alpha=None
        if target_view.trusted_alpha is None
        else target_view.camera.crop(target_view.trusted_alpha),
    )


def find_skip_reason(result: TargetResult, views: Sequence[View]) -> str | None:
    """Return a sentence why a target needs no completion, or None if it does."""
    if result.refusal is not None:
        return result.refusal
    if any(is_same_camera(result.target, view.camera) for view in views):
        return "The target is a context view: nothing to complete."
    if not result.hole_mask.any():
        return "The scene has no hole here: nothing to complete."
    return None


def append_result(
    completion: Completion, result: TargetResult, seconds: Mapping[str, float]
) -> Completion:
    """Append the result of one more target."""
    added = result.added
    return replace(
        completion,
        rendered_scene=merge([completion.rendered_scene, added])
        if len(added)
        else completion.rendered_scene,
        targets=(*completion.targets, result),
        seconds=add_seconds(completion.seconds, seconds),
    )


def check_any_completed(completion: Completion) -> None:
    """Raise InputError with the reason of the first target if every target was refused."""
    reasons = [result.refusal for result in completion.targets]
    if reasons and all(reason is not None for reason in reasons):
        more = "" if len(reasons) == 1 else f" The same holds for the other {len(reasons) - 1}."
        raise InputError(f"{reasons[0]}{more}", "target")


def get_renders(frozen_views: Sequence[FrozenScene]) -> tuple[Render, ...]:
    """Return the renders of frozen scenes."""
    return tuple(frozen.render for frozen in frozen_views)


def sort_by_distance(camera: Camera, views: Sequence[View]) -> list[int]:
    """Sort indices of `views` by their distance to `camera`."""
    return sorted(
        range(len(views)), key=lambda i: (views[i].camera.center - camera.center).norm().item()
    )


def describe_fallbacks(anchor_fallback: bool, affine: DepthAffine) -> tuple[str, ...]:
    """Return one sentence for each fallback that was taken."""
    notes = []
    if anchor_fallback:
        notes.append("Every view is turned too far; the least-turned one is the anchor.")
    if affine.is_refitted_at_target:
        notes.append(
            "The depths that fit the anchor contradict the scene at the target; they are fitted at "
            "the target instead."
        )
    if affine.is_rejected:
        notes.append(
            f"Only {affine.agreement:.0%} of the scene that the target sees agrees with the depths "
            "of the synthesized image, and no other fit is better."
        )
    if affine.method == "median":
        notes.append(
            "RANSAC finds no reliable depth correction; the median depth ratio replaces it."
        )
    if affine.method == "identity":
        notes.append(
            "There is nothing to fit a depth correction to; the predicted depths are used."
        )
    return tuple(notes)


def check_values(views: Sequence[View], scene: Gaussians | None) -> None:
    """Raise InputError for colours outside of [0, 1], or NaN or infinity in the scene."""
    for number, view in enumerate(views):
        low, high = (float(bound) for bound in view.image.aminmax())
        if not (low >= -COLOR_TOLERANCE and high <= 1 + COLOR_TOLERANCE):  # nor NaN
            raise InputError(
                f"The image of view {number} has values from {low:g} to {high:g}; colours in "
                "[0, 1] are needed."
            )
    parts = () if scene is None else (scene.means, scene.quats, scene.scales, scene.opacities)
    if not all(bool(part.isfinite().all()) for part in parts):
        raise InputError("The scene holds NaN or infinity; remove such Gaussians.")


class Clock:
    """A stopwatch of wall time per stage and in total, which also shows the running stage."""

    def __init__(self, stages: Sequence[str] = STAGES) -> None:
        self._start = time.perf_counter()
        self._seconds = dict.fromkeys(stages, 0.0)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Measure a stage and show it as running."""
        start = time.perf_counter()
        try:
            with stage(name):
                yield
        finally:
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            spent = time.perf_counter() - start
            self._seconds[name] = self._seconds.get(name, 0.0) + spent

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time of each stage so far, and of all together as `add_seconds`."""
        return {**self._seconds, "total": time.perf_counter() - self._start}


def add_seconds(before: Mapping[str, float], more: Mapping[str, float]) -> dict[str, float]:
    """Add wall times stage by stage."""
    return {stage: before[stage] + more.get(stage, 0.0) for stage in before}
