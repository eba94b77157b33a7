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
from gscompleter.config.settings import checked
from gscompleter.errors import InputError
from gscompleter.frames.thinning import thinned
from gscompleter.generators import Generator, ImageFunction, as_generator, load_generator
from gscompleter.geometry import between, bordered, project, same_camera, sample, slide, widened
from gscompleter.masks import dilate, is_enclosed
from gscompleter.progress import stage, track
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.render import (
    FrozenView,
    Renderer,
    each_view,
    image_of,
    in_colours,
    load_renderer,
)
from gscompleter.render.antialiasing import in_mode_of
from gscompleter.render.proxy import proxy_of
from gscompleter.sky import surfaces_in
from gscompleter.stages.anchor import (
    AnchorChoice,
    Synthesized,
    lift,
    select_anchor,
    synthesize_all,
)
from gscompleter.stages.candidates import shrunk
from gscompleter.stages.compared_depths import compared_depths
from gscompleter.stages.context import (
    check_texture,
    exposed_alike,
    init_context,
    sort_by_frame,
    working_range,
)
from gscompleter.stages.contradiction import contradicted
from gscompleter.stages.exploration import MAX_GAUSSIANS, overlap_of
from gscompleter.stages.free_space import respect_free_space
from gscompleter.stages.harm import do_no_harm, error_budgets
from gscompleter.stages.integration import hole_mask, keep_in_holes, refine_opacities
from gscompleter.stages.kept_views import KeptViews
from gscompleter.stages.reconciliation import reconcile
from gscompleter.stages.registration import Registration, register
from gscompleter.stages.setting_aside import not_needed
from gscompleter.stages.stereo import Stereo, corrected, stereo_among
from gscompleter.stages.support import (
    believed_alpha,
    front,
    gather_evidence,
    shown,
    support,
    weight_sums,
)
from gscompleter.types import (
    Camera,
    Completion,
    DepthAffine,
    Evidence,
    Gaussians,
    InitialContext,
    Lift,
    Render,
    SceneContext,
    TargetCompletion,
    View,
    Window,
    merge,
)

MAX_TARGETS = 255
"""Largest target id: `generated` is one byte per Gaussian, and 0 means observed."""

UNSEEN = 0.1
"""Fraction of a Gaussian's visible area below which a photograph does not observe it."""
COLOUR_SLACK = 0.01
"""Largest tolerated excess of a colour beyond [0, 1], as resampling causes it."""
MIN_COVER = 0.5
"""Hole pixels that a Gaussian has to cover to count as an occluder."""

MADE_WORSE = "Most of the Gaussians that were generated here make photographs worse."
NOTHING_ADDED = "Nothing of it was added."

STAGES = ("context", "generate", "lift", "register", "integrate")
"""Stages whose wall time is recorded."""


@dataclass(frozen=True)
class Sight:
    """The scene as the padded target camera sees it, before anything is added."""

    completion: Completion
    window: Window
    frozen: FrozenView
    """The scene frozen at the padded camera."""
    anchor: AnchorChoice
    believed: Float[Tensor, "h w"] | None = None
    """Alpha at the padded camera weighted by trust, or None under full trust."""
    stereo: Stereo | None = None
    """MVS render of the photographs at the padded camera, or None if not computed."""

    @property
    def alpha(self) -> Float[Tensor, "h w"]:
        """Alpha that the hole mask thresholds, at the padded camera."""
        return self.frozen.context.alpha if self.believed is None else self.believed

    @property
    def before(self) -> Render:
        """Render of the scene at the target, without padding."""
        return self.frozen.context.cropped(self.window)

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
        checked(self.config, "config.")

    @cached_property
    def frozen(self) -> KeptViews:
        """The current scene, frozen at the cameras of its photographs."""
        return KeptViews(self.renderer)

    @cached_property
    def small(self) -> KeptViews:
        """A simplified version of the current scene, frozen at the cameras of small images."""
        return KeptViews(self.renderer, partial(thinned, most=MAX_GAUSSIANS))

    def __call__(
        self,
        views: Sequence[View],
        target: Camera | Sequence[Camera],
        scene: Gaussians | None = None,
        witnesses: Sequence[View] | None = None,
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
        check_numbers(scene, len(targets))
        completion = self.begin(views, scene, witnesses, targets)
        at_once = as_generator(self.generator).at_once
        counted_as = "target" if at_once == 1 else "group of targets"
        for start in track(range(0, len(targets), at_once), counted_as):
            completion = self.advance_together(completion, targets[start : start + at_once])
        check_any_completed(completion)
        return completion

    def begin(
        self,
        views: Sequence[View],
        scene: Gaussians | None = None,
        witnesses: Sequence[View] | None = None,
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
        check_values([*views, *(witnesses or ())], scene)
        if scene is None:
            return self.begin_with(self.reconstruct(views))
        clock = Clock()
        with clock("context"):
            cameras = [*targets, *(view.camera for view in (*views, *(witnesses or ())))]
            proxy = proxy_of(scene, cameras)
            rendered = scene if proxy is None else proxy.scene
            near, far = working_range(views, rendered, self.renderer)
            views = tuple(ranged(view, near, far) for view in views)
            others = tuple(ranged(view, near, far) for view in witnesses or ())
            completion = Completion(rendered, scene, views, (), (), {}, others, proxy=proxy)
            if witnesses is not None and self.config.trust == "photometric":
                completion = self.doubted(completion)
            completion = self.judged(completion)
        return replace(completion, seconds=clock.seconds)

    def reconstruct(self, views: Sequence[View]) -> InitialContext:
        """Reconstruct the context from posed photographs (paper, Eq. 5)."""
        clock = Clock()
        with clock("context"):
            check_texture(views)
            near, far = working_range(views, None, self.renderer)
            views = [ranged(view, near, far) for view in views]
            gaussians, gains = init_context(self.reconstructor, views)
        return InitialContext(gaussians, exposed_alike(views, gains), gains, clock.seconds)

    def begin_with(self, context: InitialContext) -> Completion:
        """Begin from a reconstructed context: compute dynamic masks and error budgets."""
        clock = Clock()
        with clock("context"):
            scene = context.gaussians
            completion = Completion(scene, scene, context.views, (), (), {}, gains=context.gains)
            completion = self.judged(self.wary_of_what_moved(completion))
        return replace(completion, seconds=total(clock.seconds, context.seconds))

    def advance(
        self, completion: Completion, target: Camera, reference: Synthesized | None = None
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
        check_numbers(completion.context, len(completion.targets) + 1)
        clock = Clock()
        with clock("context"):
            padded = None if reference is None else reference.camera
            target_view = self.sight(completion, target, padded)
        result = self.begun_at(target_view)
        reason = nothing_to_do(result, completion.views)
        if reason is not None:
            return followed_by(completion, replace(result, notes=(reason,)), clock.seconds)
        with clock("context"):
            target_view = self.without_unsupported(target_view)
        result = self.completed(target_view, result, reference, clock)
        base = target_view.completion if len(result.added) else completion
        advanced = followed_by(base, result, clock.seconds)
        for cache in (self.frozen, self.small):
            cache.grown(base.drawn, advanced.drawn)
        return advanced

    def completed(
        self, sight: Sight, result: TargetCompletion, reference: Synthesized | None, clock: Clock
    ) -> TargetCompletion:
        """Run stages 2 to 4 for an observed target and fill in its result."""
        completion, target = sight.completion, sight.window.target
        with clock("generate"):
            frozen_views = self.at(completion, completion.views)
            if reference is None:
                (reference,) = self.synthesize([sight], contexts_of(frozen_views))
        result = replace(result, reference=View(sight.window.crop(reference.image), target))
        if reference.disagrees and self.config.psnr_guard.max_opacity_loss is not None:
            return replace(result, notes=(*reference.notes, NOTHING_ADDED))
        with clock("lift"):
            lifted = self.lift(sight, reference)
        with clock("register"):
            registration = self.register(sight, lifted, reference, frozen_views)
        at_anchor = frozen_views[sight.anchor.index].context
        fit, settings = registration.affine, self.config.alignment
        pairs = compared_depths(lifted, sight.frozen.context, at_anchor, fit, settings)
        everything = registration.gaussians if self.keep_registered else None
        result = replace(result, affine=fit, pairs=pairs, registered=everything)
        if registration.affine.refuted:
            notes = notes_of(sight.anchor.fallback, registration.affine)
            return replace(result, notes=(*reference.notes, *notes, NOTHING_ADDED))
        with clock("integrate"):
            kept = self.keep(sight, lifted, registration, frozen_views)
            added, losses = self.refine(sight, kept, reference)
            after = sight.frozen.composite(added).cropped(sight.window)
        return replace(
            result,
            after=after,
            added=added,
            losses={"register": registration.losses, "refine": losses},
            notes=(
                *reference.notes,
                *notes_of(sight.anchor.fallback, registration.affine),
                *((MADE_WORSE, NOTHING_ADDED) if len(added) < len(kept) else ()),
            ),
        )

    def advance_together(self, completion: Completion, targets: Sequence[Camera]) -> Completion:
        """Complete several targets, whose images Φ synthesizes in one call."""
        if len(targets) < 2:
            return reduce(self.advance, targets, completion)
        references, seconds = self.references(completion, targets)
        completion = replace(completion, seconds=total(completion.seconds, seconds))
        for target, reference in zip(targets, references, strict=True):
            completion = self.advance(completion, target, reference)
        return completion

    def reference(self, completion: Completion, target: Camera) -> View:
        """Synthesize the image at a target, without padding, even if there is no hole."""
        target_view = self.sight(completion, target)
        at_views = contexts_of(self.at(completion, completion.views))
        (image,) = self.synthesize([target_view], at_views)
        return View(target_view.window.crop(image.image), target_view.window.target)

    def begun_at(self, sight: Sight) -> TargetCompletion:
        """Begin the result of a target; refuse the target if it sees too little of the scene."""
        result = nothing_added(sight, sight.window.crop(self.holes(sight)))
        covered = surfaces_in(result.before, result.target).valid.float().mean().item()
        least = self.config.holes.min_covered
        if covered >= least:
            return result
        reason = (
            f"The target sees surfaces of the scene in {covered:.1%} of its image, and at least "
            f"{least:.0%} are needed; move it closer to the photographs, or turn it towards what "
            "they show."
        )
        return replace(result, refused=reason)

    def references(
        self, completion: Completion, targets: Sequence[Camera]
    ) -> tuple[list[Synthesized | None], Mapping[str, float]]:
        """Synthesize the images of all targets that have holes; also return the seconds."""
        clock = Clock()
        with clock("context"):
            target_views = [self.sight(completion, target) for target in targets]
            results = [self.begun_at(target_view) for target_view in target_views]
            has_hole = [nothing_to_do(result, completion.views) is None for result in results]
            at_views = contexts_of(self.at(completion, completion.views))
        with clock("generate"):
            open_views = [
                target_view
                for target_view, needed in zip(target_views, has_hole, strict=True)
                if needed
            ]
            images = iter(self.synthesize(open_views, at_views))
        return [next(images) if needed else None for needed in has_hole], clock.seconds

    def synthesize(self, sights: Sequence[Sight], at_views: Sequence[Render]) -> list[Synthesized]:
        """Synthesize the image of each padded target (stage 2)."""
        inputs = [
            (target_view.window.wide, self.known(target_view, at_views)) for target_view in sights
        ]
        return synthesize_all(self.generator, inputs) if inputs else []

    def known(self, sight: Sight, at_views: Sequence[Render]) -> SceneContext:
        """Collect the input of Φ at a target."""
        synthesis = self.config.synthesis
        context = SceneContext(
            sight.completion.views,
            tuple(at_views),
            sight.frozen.context,
            self.config.holes.max_alpha,
            synthesis.correct_color,
            synthesis.source_depth,
            sight.believed,
        )
        return context if sight.stereo is None else corrected(context, sight.stereo)

    def lift(self, sight: Sight, reference: Synthesized) -> Lift:
        """Lift the pixels near holes to Gaussians in the antialiasing mode of the scene."""
        radius = self.config.holes.candidate_radius
        pixel_mask = None if radius is None else dilate(self.holes(sight), radius)
        lifted = lift(self.reconstructor, reference, sight.anchor_view, pixel_mask)
        scene, gaussians = sight.completion.drawn, lifted.gaussians
        return replace(lifted, gaussians=in_mode_of(scene, gaussians, reference.camera))

    def register(
        self,
        sight: Sight,
        lifted: Lift,
        reference: Synthesized,
        frozen_views: Sequence[FrozenView],
    ) -> Registration:
        """Register the lifted Gaussians to the scene (stage 3)."""
        return register(
            lifted,
            sight.frozen,
            frozen_views[sight.anchor.index].context,
            reference,
            sight.anchor_view.camera,
            self.renderer,
            torch.Generator().manual_seed(self.seed),
            self.config.registration,
            self.config.holes.max_alpha,
            self.config.alignment,
            self.reject_below(sight),
        )

    def reject_below(self, sight: Sight) -> float | None:
        """Return the depth agreement that a target needs.

        With photometric trust it needs none: where the scene is wrong, right depths differ from it.
        """
        return self.config.depth_agreement.reject_below if sight.believed is None else None

    def keep(
        self,
        sight: Sight,
        lifted: Lift,
        registration: Registration,
        frozen_views: Sequence[FrozenView],
    ) -> Gaussians:
        """Keep registered Gaussians in holes, outside of observed free space (stage 4)."""
        mask = dilate(self.holes(sight), self.config.holes.dilation)
        padded, views = sight.window.wide, sight.completion.views
        side, earlier = self.config.next_best_view.image_size, sight.completion.targets
        completed_cameras = [result.target for result in earlier if len(result.added)]
        small_cameras = [
            shrunk(camera, side) for camera in (*sight.completion.bystanders, *completed_cameras)
        ]
        kept, is_placed = respect_free_space(
            self.before_doubted(
                keep_in_holes(registration.gaussians, lifted.pixel_index, mask, padded), sight
            ),
            padded,
            [*(view.camera for view in views), *small_cameras],
            [
                *(self.as_believed(sight, f, v) for f, v in zip(frozen_views, views, strict=True)),
                *self.small_renders(sight.completion, small_cameras),
            ],
            self.config.registration.footprint,
            self.config.free_space,
        )
        kept = kept[is_placed]
        number = torch.full_like(kept.generated, sight.completion.next_number)
        return replace(kept, generated=number)

    def as_believed(self, sight: Sight, frozen: FrozenView, view: View) -> Render:
        """Weight the alpha of a photograph's render by trust."""
        render = frozen.context
        alpha = self.believed(sight.completion, frozen, view.camera)
        return render if alpha is None else replace(render, alpha=alpha)

    def before_doubted(self, kept: Gaussians, sight: Sight) -> Gaussians:
        """Move Gaussians in front of untrusted Gaussians that were not pruned."""
        if sight.believed is None or len(kept) == 0:
            return kept
        camera, scene = sight.window.wide, sight.completion.drawn
        nearest = front(scene, sight.frozen, camera)
        pixels, z = project(kept.means, camera)
        limit = sample(nearest[..., None], pixels, "nearest")[:, 0]
        covered = sample(sight.frozen.context.alpha[..., None], pixels, "nearest")[:, 0] > 0.1
        ratio = torch.where(covered & (limit > 0), (limit / z).clamp_max(1.0), 1.0)
        return slide(kept, camera, ratio, self.config.registration.footprint)

    def refine(
        self, sight: Sight, kept: Gaussians, reference: Synthesized
    ) -> tuple[Gaussians, tuple[float, ...]]:
        """Refine new Gaussians and fade those that harm photographs (stage 4)."""
        completion, config = sight.completion, self.config
        budgets = completion.budgets
        frozen = self.at(completion, completion.photographs)
        if completion.evidence is None:
            nearest = nearest_views(reference.camera, completion.views)[: config.refine.num_views]
            near_views = [completion.views[i] for i in nearest]
            planned = [view.plan(kept) for view in frozen]
            near = [planned[i] for i in nearest]
            at_target = sight.frozen.plan(kept)
            refined, losses = refine_opacities(
                kept, at_target, reference, near, near_views, config.refine
            )
            images = [image_of(plan) for plan in planned]
        else:
            holes, degree = self.holes(sight), completion.context.sh_degree
            settings = config.reconcile.at_most(degree)
            valid_masks = [view.counted for view in completion.photographs]
            plans = list(
                each_view(kept)(lambda v, c: v.plan_appearance(kept, c), frozen, valid_masks)
            )
            first_budgets = [first for first, *_ in budgets]
            refined, losses = reconcile(
                kept, sight.frozen, reference, holes, plans, first_budgets, settings
            )
            images = [in_colours(plan, refined.sh) for plan in plans]
        return do_no_harm(refined, frozen, budgets, config.psnr_guard, images), losses

    def sight(self, completion: Completion, target: Camera, wide: Camera | None = None) -> Sight:
        """Render the scene at a target, padded if a hole reaches the border.

        A reference that was synthesized in advance determines the padding by its camera, `padded`.
        """
        camera = self.window(completion, target)
        if wide is not None:
            camera = between(camera.target, wide)
        target_view = self.without_stereo(completion, camera)
        if wide is None and is_enclosed(camera.crop(self.holes(target_view))):
            target_view = self.without_stereo(completion, bordered(camera.target, 0, 0))
        found = self.stereo(completion, target_view.frozen.context, target_view.window)
        return replace(target_view, stereo=found)

    def without_stereo(self, completion: Completion, window: Window) -> Sight:
        """Render the scene at a padded target, without stereo among the photographs."""
        frozen = self.renderer.freeze(completion.drawn, window.wide)
        anchor = self.anchor(completion, window.target)
        return Sight(
            completion, window, frozen, anchor, self.believed(completion, frozen, window.wide)
        )

    def anchor(self, completion: Completion, target: Camera) -> AnchorChoice:
        """Select the stereo anchor of a target."""
        config, views = self.config.anchor, completion.views
        if config.min_overlap == 0:
            return select_anchor(target, views, config)
        cameras = [
            shrunk(c, self.config.next_best_view.image_size)
            for c in (target, *(view.camera for view in views))
        ]
        seen, *at_views = self.small_renders(completion, cameras)
        overlaps = [
            overlap_of(cameras[0], seen, camera, render)
            for camera, render in zip(cameras[1:], at_views, strict=True)
        ]
        return select_anchor(target, views, config, overlaps)

    def stereo(self, completion: Completion, drawn: Render, window: Window) -> Stereo | None:
        """Render stereo among the photographs at the padded target; None under full trust."""
        cameras = [view.camera for view in completion.views]
        if completion.evidence is None or any(same_camera(window.target, c) for c in cameras):
            return None
        return stereo_among(
            completion.views,
            window.wide,
            drawn,
            self.reconstructor,
            self.renderer,
            self.config.trust_settings,
        )

    def believed(
        self, completion: Completion, frozen: FrozenView, camera: Camera
    ) -> Float[Tensor, "h w"] | None:
        """Compute alpha weighted by trust at a camera; None under full trust."""
        if completion.evidence is None:
            return None
        values = self.support(completion, completion.evidence, frozen, camera)
        return believed_alpha(frozen, values)

    def support(
        self, completion: Completion, evidence: Evidence, frozen: FrozenView, camera: Camera
    ) -> Float[Tensor, "n"]:
        """Compute the trust of every rendered Gaussian; generated and invisible ones have 1."""
        sums, kept = weight_sums(frozen), completion.num_kept
        seen = in_context(completion, sums[:kept])
        trust = support(evidence, seen, camera, self.config.trust_settings)
        values = torch.ones_like(sums)
        values[:kept] = of_kept(completion, trust)
        return values

    def doubted(self, completion: Completion) -> Completion:
        """Add the photographs' observations of an input splat, before any target."""
        views, scene = completion.photographs, completion.drawn
        frozen_views = self.at(completion, views)
        observations = gather_evidence(scene, views, frozen_views, self.config.trust_settings)
        return replace(completion, evidence=observations)

    def without_unsupported(self, sight: Sight) -> Sight:
        """Prune occluders: unobserved Gaussians that cover holes and that no photograph needs.

        Without check views nothing is pruned, as other photographs may show those Gaussians.
        """
        completion, config = sight.completion, self.config.trust_settings
        if completion.evidence is None or not completion.witnesses or not config.prune:
            return sight
        occluders = self.unseen_in_holes(sight, completion.evidence)
        if not occluders.any():
            return sight
        removable = self.not_needed(completion, occluders)
        if not removable.any():
            return sight
        pruned_view = self.without_stereo(without(completion, removable), sight.window)
        # Stereo depends on the photographs only, which do not change.
        return replace(pruned_view, stereo=sight.stereo)

    def not_needed(self, completion: Completion, doubtful: Bool[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """Find those of the given Gaussians that can be removed without harm to any photograph."""
        views, rest = completion.photographs, completion.drawn[~doubtful]
        cameras = [view.camera for view in views]
        around = each_view(rest)(partial(self.renderer.freeze, rest), cameras)
        self.frozen.forget()  # Free memory: the next scene lacks `doubtful`.
        removable = not_needed(completion.drawn[doubtful], around, views)
        return doubtful.masked_scatter(doubtful, removable)

    def unseen_in_holes(self, sight: Sight, evidence: Evidence) -> Bool[Tensor, "n"]:
        """Find context Gaussians that cover holes and that no photograph shows."""
        completion, camera = sight.completion, sight.window.wide
        scene, holes = completion.drawn, self.holes(sight)
        everywhere = torch.ones_like(sight.alpha)
        layers = torch.stack([everywhere, holes.to(everywhere), 0 * everywhere], dim=-1)
        sums, covering, _ = sight.frozen.sums(layers).unbind(-1)
        is_occluder = (covering > MIN_COVER) & (scene.generated == 0)
        kept = completion.num_kept
        seen = shown(evidence, in_context(completion, sums[:kept]), camera)
        is_occluder[:kept] &= of_kept(completion, seen) < UNSEEN
        is_occluder[kept:] = False
        return is_occluder

    def window(self, completion: Completion, target: Camera) -> Window:
        """Pad a target camera by as much as the settings and Φ allow."""
        takes_margin = as_generator(self.generator).takes_margin
        return widened(completion.ranged(target), self.config.margin if takes_margin else 0.0)

    def holes(self, sight: Sight) -> Bool[Tensor, "h w"]:
        """Compute the hole mask at the padded camera."""
        return hole_mask(sight.alpha, self.config.holes)

    def wary_of_what_moved(self, completion: Completion) -> Completion:
        """Add dynamic masks to the context views."""
        views, renders = completion.views, contexts_of(self.at(completion, completion.views))
        masks = contradicted(views, renders, self.config.dynamic_masks)
        return replace(
            completion,
            views=tuple(
                replace(view, contradicted=mask if mask.any() else None)
                for view, mask in zip(views, masks, strict=True)
            ),
        )

    def judged(self, completion: Completion) -> Completion:
        """Add the error budgets of all photographs, before any target."""
        config = self.config.psnr_guard
        tolerance = 0.0 if completion.evidence is not None else config.max_drop or 0.0
        renders = contexts_of(self.at(completion, completion.photographs))
        budgets = tuple(
            error_budgets(
                view,
                render.image,
                hole_mask(render.alpha, self.config.holes),
                tolerance,
                config.max_ssim_drop,
            )
            for view, render in zip(completion.photographs, renders, strict=True)
        )
        return replace(completion, budgets=budgets, begun=renders[: len(completion.views)])

    def at(self, completion: Completion, views: Sequence[View]) -> tuple[FrozenView, ...]:
        """Freeze the scene at the cameras of photographs."""
        return self.frozen.of(completion, [view.camera for view in views])

    def small_renders(self, completion: Completion, cameras: Sequence[Camera]) -> Sequence[Render]:
        """Render a simplified scene at cameras of small images."""
        return contexts_of(self.small.of(completion, cameras))


def ranged(view: View, near: float, far: float) -> View:
    """Return the view with a depth range in scene units."""
    return replace(view, camera=replace(view.camera, near=near, far=far))


def without(completion: Completion, taken: Bool[Tensor, "n"]) -> Completion:
    """Prune rendered Gaussians of the context."""
    before, new = completion.set_aside, in_context(completion, taken[: completion.num_kept])
    pruned = new if before is None else before | new
    return replace(completion, drawn=completion.drawn[~taken], set_aside=pruned)


def in_context(completion: Completion, values: Shaped[Tensor, "kept"]) -> Shaped[Tensor, "m"]:
    """Map values of kept context Gaussians to all rendered ones; pruned ones get 0."""
    pruned = completion.set_aside
    if pruned is None:
        return values
    return values.new_zeros(len(pruned)).masked_scatter(~pruned, values)


def of_kept(completion: Completion, values: Shaped[Tensor, "m"]) -> Shaped[Tensor, "kept"]:
    """Select the values of context Gaussians that are not pruned."""
    pruned = completion.set_aside
    return values if pruned is None else values[~pruned]


def check_numbers(scene: Gaussians | None, num_targets: int) -> None:
    """Raise InputError if `generated` cannot hold the ids of `num_targets` more targets."""
    given = 0 if scene is None or len(scene) == 0 else int(scene.generated.max())
    if given + num_targets > MAX_TARGETS:
        raise InputError(
            f"{num_targets} targets were given after {given} in the scene, and a .ply can tell "
            f"{MAX_TARGETS} apart; complete the scene in several runs."
        )


def nothing_added(sight: Sight, holes: Bool[Tensor, "h w"]) -> TargetCompletion:
    """Return the result of a target to which nothing was added."""
    return TargetCompletion(
        target=sight.window.target,
        before=sight.before,
        after=sight.before,
        hole_mask=holes,
        reference=None,
        anchor=sight.anchor.index,
        anchor_fallback=sight.anchor.fallback,
        affine=DepthAffine(),
        added=sight.completion.drawn[:0],
        support=None if sight.believed is None else sight.window.crop(sight.believed),
    )


def nothing_to_do(result: TargetCompletion, views: Sequence[View]) -> str | None:
    """Return a sentence why a target needs no completion, or None if it does."""
    if result.refused is not None:
        return result.refused
    if any(same_camera(result.target, view.camera) for view in views):
        return "The target is a context view: nothing to complete."
    if not result.hole_mask.any():
        return "The scene has no hole here: nothing to complete."
    return None


def followed_by(
    completion: Completion, result: TargetCompletion, seconds: Mapping[str, float]
) -> Completion:
    """Append the result of one more target."""
    added = result.added
    return replace(
        completion,
        drawn=merge([completion.drawn, added]) if len(added) else completion.drawn,
        targets=(*completion.targets, result),
        seconds=total(completion.seconds, seconds),
    )


def check_any_completed(completion: Completion) -> None:
    """Raise InputError with the reason of the first target if every target was refused."""
    reasons = [result.refused for result in completion.targets]
    if reasons and all(reason is not None for reason in reasons):
        more = "" if len(reasons) == 1 else f" The same holds for the other {len(reasons) - 1}."
        raise InputError(f"{reasons[0]}{more}", "target")


def contexts_of(frozen_views: Sequence[FrozenView]) -> tuple[Render, ...]:
    """Return the renders of frozen scenes."""
    return tuple(frozen.context for frozen in frozen_views)


def nearest_views(camera: Camera, views: Sequence[View]) -> list[int]:
    """Sort indices of `views` by their distance to `camera`."""
    return sorted(
        range(len(views)), key=lambda i: (views[i].camera.center - camera.center).norm().item()
    )


def notes_of(anchor_fallback: bool, affine: DepthAffine) -> tuple[str, ...]:
    """Return one sentence for each fallback that was taken."""
    notes = []
    if anchor_fallback:
        notes.append("Every view is turned too far; the least-turned one is the anchor.")
    if affine.contradicted:
        notes.append(
            "The depths that fit the anchor contradict the scene at the target; they are fitted at "
            "the target instead."
        )
    if affine.refuted:
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
        if not (low >= -COLOUR_SLACK and high <= 1 + COLOUR_SLACK):  # nor NaN
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
        """Wall time of each stage so far, and of all together as `total`."""
        return {**self._seconds, "total": time.perf_counter() - self._start}


def total(before: Mapping[str, float], more: Mapping[str, float]) -> dict[str, float]:
    """Add wall times stage by stage."""
    return {stage: before[stage] + more.get(stage, 0.0) for stage in before}
