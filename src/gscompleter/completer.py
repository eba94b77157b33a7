"""GSCompleter: a scene is taken up once, then advanced by the four stages, target after target."""

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
"""Provenance is a byte per Gaussian: 0 for observed, 1 to 255 for the targets."""

UNSEEN = 0.1
"""Share of what the target sees of a Gaussian, below which no photograph shows it."""
COLOUR_SLACK = 0.01
"""By how much a colour may lie outside of [0, 1], as resampling leaves it."""
MIN_COVER = 0.5
"""Pixels of a hole that a Gaussian has to cover to stand in the way."""

MADE_WORSE = "Most of what was synthesized here made photographs worse."
NOTHING_ADDED = "Nothing of it was added."

STAGES = ("context", "generate", "lift", "register", "integrate")
"""What a completion spends its time on."""


@dataclass(frozen=True)
class Sight:
    """What a target camera meets in the scene as it stands."""

    completion: Completion
    """As far as it went before this target."""
    window: Window
    """The target, and the wider camera that it is completed with."""
    frozen: FrozenView
    """The scene frozen at the wider camera."""
    anchor: AnchorChoice
    believed: Float[Tensor, "h w"] | None = None
    """Alpha at the wider camera as far as photographs support it; None where nothing is
    doubted."""
    stereo: Stereo | None = None
    """What stereo among the photographs shows there; None where nothing is doubted or that was not
    asked."""

    @property
    def alpha(self) -> Float[Tensor, "h w"]:
        """What counts against holes, at the wider camera."""
        return self.frozen.context.alpha if self.believed is None else self.believed

    @property
    def before(self) -> Render:
        """The scene as the target itself sees it."""
        return self.frozen.context.cropped(self.window)

    @property
    def anchor_view(self) -> View:
        """The photograph that forms the stereo pair with the target."""
        return self.completion.views[self.anchor.index]


@dataclass(frozen=True)
class GSCompleter:
    """Completes a scene as seen from one or several target cameras.

    The defaults are the embedded models, which need no weights and no GPU.
    """

    reconstructor: Reconstructor = field(default_factory=lambda: load_reconstructor("plane-sweep"))
    """Ψ: views -> Gaussians and depth maps."""
    generator: Generator | ImageFunction = field(
        default_factory=lambda: load_generator("warp-inpaint")
    )
    """Φ: nearest view and target camera -> image."""
    renderer: Renderer = field(default_factory=lambda: load_renderer("cpu"))
    """Draws Gaussians, differentiably."""
    config: CompleterConfig = CompleterConfig()
    """Settings of the stages."""
    seed: int = 0
    """Of the random samples that RANSAC draws."""
    keep_registered: bool = False
    """Keep in each result all that was registered, about a Gaussian per pixel, for evaluation."""

    def __post_init__(self) -> None:
        """Raises InputError where a setting is out of its range."""
        checked(self.config, "config.")

    @cached_property
    def frozen(self) -> KeptViews:
        """The scene that was worked on last, frozen at the cameras of its photographs."""
        return KeptViews(self.renderer)

    @cached_property
    def small(self) -> KeptViews:
        """The same at cameras of small images, about."""
        return KeptViews(self.renderer, partial(thinned, most=MAX_GAUSSIANS))

    def __call__(
        self,
        views: Sequence[View],
        target: Camera | Sequence[Camera],
        scene: Gaussians | None = None,
        witnesses: Sequence[View] | None = None,
    ) -> Completion:
        """Complete what `views` never saw, as seen from `target`.

        Args:
            views: Photographs with their cameras: at least two, or one with `scene`. Those with
                frame numbers are sorted by them.
            target: The camera (or cameras, completed one after the other into one scene; a
                generator that takes several at once is asked for their images before that).
            scene: Gaussians that are the context already, in the frame and unit of the cameras;
                they are kept as they are. Without it Ψ reconstructs the context from `views`.
            witnesses: The other photographs of `scene`, which may be small. Given them, it is
                doubted where no photograph supports it, what nothing supports and nothing needs is
                set aside, and none of them may get worse. Without them it is taken as it is.

        Raises:
            InputError: too few views, no baseline, too many targets, a scene nobody sees, or no
                target that sees enough of it.
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
        """Stage 1: the scene and its photographs before any target.

        Args:
            views: As in a call.
            scene: As in a call.
            witnesses: As in a call.
            targets: Those that are known in advance. A large scene is drawn as finely as they and
                the photographs can tell.

        Raises:
            InputError: too few views, no baseline, a scene nobody sees.
        """
        if len(views) < (2 if scene is None else 1):
            raise InputError(
                f"{len(views)} context view was given, and stereo needs at least 2; name more "
                "frames, or bring a scene."
            )
        views = sort_by_frame(views)
        check_values([*views, *(witnesses or ())], scene)
        if scene is None:
            return self.begin_with(self.reconstruct(views))
        clock = Clock()
        with clock("context"):
            cameras = [*targets, *(view.camera for view in (*views, *(witnesses or ())))]
            proxy = proxy_of(scene, cameras)
            drawn = scene if proxy is None else proxy.scene
            near, far = working_range(views, drawn, self.renderer)
            views = tuple(ranged(view, near, far) for view in views)
            others = tuple(ranged(view, near, far) for view in witnesses or ())
            completion = Completion(drawn, scene, views, (), (), {}, others, proxy=proxy)
            if witnesses is not None and self.config.trust == "photometric":
                completion = self.doubted(completion)
            completion = self.judged(completion)
        return replace(completion, seconds=clock.seconds)

    def reconstruct(self, views: Sequence[View]) -> InitialContext:
        """Reconstruct the context from posed photographs (paper, Eq. 5).

        Raises:
            InputError: too few views, no baseline.
        """
        clock = Clock()
        with clock("context"):
            check_texture(views)
            near, far = working_range(views, None, self.renderer)
            views = [ranged(view, near, far) for view in views]
            gaussians, gains = init_context(self.reconstructor, views)
        return InitialContext(gaussians, exposed_alike(views, gains), gains, clock.seconds)

    def begin_with(self, context: InitialContext) -> Completion:
        """Begin the completion of a reconstructed context: find what moved, set error budgets."""
        clock = Clock()
        with clock("context"):
            made = context.gaussians
            completion = Completion(made, made, context.views, (), (), {}, gains=context.gains)
            completion = self.judged(self.wary_of_what_moved(completion))
        return replace(completion, seconds=total(clock.seconds, context.seconds))

    def advance(
        self, completion: Completion, target: Camera, reference: Synthesized | None = None
    ) -> Completion:
        """Stages 2 to 4 for one target: the scene with what they add to it.

        Args:
            completion: Where it goes on from; it stays as it is.
            target: The camera to complete the scene for.
            reference: The image at the target (at its wider camera, where the generator takes a
                margin). The generator is asked for it if it is left out.

        Raises:
            InputError: where the targets before are as many as a .ply can tell apart.
        """
        check_numbers(completion.context, len(completion.targets) + 1)
        clock = Clock()
        with clock("context"):
            wide = None if reference is None else reference.camera
            sight = self.sight(completion, target, wide)
        result = self.begun_at(sight)
        reason = nothing_to_do(result, completion.views)
        if reason is not None:
            return followed_by(completion, replace(result, notes=(reason,)), clock.seconds)
        with clock("context"):
            sight = self.without_unsupported(sight)
        result = self.completed(sight, result, reference, clock)
        reached = sight.completion if len(result.added) else completion
        advanced = followed_by(reached, result, clock.seconds)
        for kept in (self.frozen, self.small):
            kept.grown(reached.drawn, advanced.drawn)
        return advanced

    def completed(
        self, sight: Sight, result: TargetCompletion, reference: Synthesized | None, clock: Clock
    ) -> TargetCompletion:
        """`result` once the four stages have done their work."""
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
        """`advance` by each of `targets`, whose images are synthesized in one go beforehand."""
        if len(targets) < 2:
            return reduce(self.advance, targets, completion)
        references, seconds = self.references(completion, targets)
        completion = replace(completion, seconds=total(completion.seconds, seconds))
        for target, reference in zip(targets, references, strict=True):
            completion = self.advance(completion, target, reference)
        return completion

    def reference(self, completion: Completion, target: Camera) -> View:
        """The image of Φ as far as `target` sees it, whether or not there is a hole.

        It is the one that `advance` would take: drawn with the margin, which is then cut off.
        """
        sight = self.sight(completion, target)
        at_views = contexts_of(self.at(completion, completion.views))
        (image,) = self.synthesize([sight], at_views)
        return View(sight.window.crop(image.image), sight.window.target)

    def begun_at(self, sight: Sight) -> TargetCompletion:
        """Begin the result of a target; refuse one that sees too little of the scene."""
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
        """The image at each target where there is something to complete, and the seconds taken."""
        clock = Clock()
        with clock("context"):
            sights = [self.sight(completion, target) for target in targets]
            results = [self.begun_at(sight) for sight in sights]
            asked = [nothing_to_do(result, completion.views) is None for result in results]
            at_views = contexts_of(self.at(completion, completion.views))
        with clock("generate"):
            wanted = [sight for sight, needed in zip(sights, asked, strict=True) if needed]
            found = iter(self.synthesize(wanted, at_views))
        return [next(found) if needed else None for needed in asked], clock.seconds

    def synthesize(self, sights: Sequence[Sight], at_views: Sequence[Render]) -> list[Synthesized]:
        """Stage 2: Φ's image at each of the wider cameras."""
        asked = [(sight.window.wide, self.known(sight, at_views)) for sight in sights]
        return synthesize_all(self.generator, asked) if asked else []

    def known(self, sight: Sight, at_views: Sequence[Render]) -> SceneContext:
        """What Φ is told of the scene."""
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
        """Stage 2: the image as Gaussians, those that lie near a hole, in the mode of the scene."""
        radius = self.config.holes.candidate_radius
        wanted = None if radius is None else dilate(self.holes(sight), radius)
        lifted = lift(self.reconstructor, reference, sight.anchor_view, wanted)
        scene, made = sight.completion.drawn, lifted.gaussians
        return replace(lifted, gaussians=in_mode_of(scene, made, reference.camera))

    def register(
        self,
        sight: Sight,
        lifted: Lift,
        reference: Synthesized,
        frozen_views: Sequence[FrozenView],
    ) -> Registration:
        """Stage 3: the candidates at the depth of the scene."""
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
        """Stage 4: what lies in the holes, where no photograph and no earlier target sees through
        it."""
        mask = dilate(self.holes(sight), self.config.holes.dilation)
        wide, views = sight.window.wide, sight.completion.views
        side, earlier = self.config.next_best_view.image_size, sight.completion.targets
        completed = [result.target for result in earlier if len(result.added)]
        aside = [shrunk(camera, side) for camera in (*sight.completion.bystanders, *completed)]
        kept, placed = respect_free_space(
            self.before_doubted(
                keep_in_holes(registration.gaussians, lifted.pixel_index, mask, wide), sight
            ),
            wide,
            [*(view.camera for view in views), *aside],
            [
                *(self.as_believed(sight, f, v) for f, v in zip(frozen_views, views, strict=True)),
                *self.small_renders(sight.completion, aside),
            ],
            self.config.registration.footprint,
            self.config.free_space,
        )
        kept = kept[placed]
        number = torch.full_like(kept.generated, sight.completion.next_number)
        return replace(kept, generated=number)

    def as_believed(self, sight: Sight, frozen: FrozenView, view: View) -> Render:
        """The scene at a photograph, with alpha as far as photographs support it."""
        drawn = frozen.context
        believed = self.believed(sight.completion, frozen, view.camera)
        return drawn if believed is None else replace(drawn, alpha=believed)

    def before_doubted(self, kept: Gaussians, sight: Sight) -> Gaussians:
        """`kept` before what is doubted at the target and stays, since photographs need it."""
        if sight.believed is None or len(kept) == 0:
            return kept
        camera, drawn = sight.window.wide, sight.completion.drawn
        nearest = front(drawn, sight.frozen, camera)
        pixels, z = project(kept.means, camera)
        limit = sample(nearest[..., None], pixels, "nearest")[:, 0]
        covered = sample(sight.frozen.context.alpha[..., None], pixels, "nearest")[:, 0] > 0.1
        ratio = torch.where(covered & (limit > 0), (limit / z).clamp_max(1.0), 1.0)
        return slide(kept, camera, ratio, self.config.registration.footprint)

    def refine(
        self, sight: Sight, kept: Gaussians, reference: Synthesized
    ) -> tuple[Gaussians, tuple[float, ...]]:
        """Stage 4: what joins the scene with the opacities it has there, and the losses."""
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
            drawings = [image_of(plan) for plan in planned]
        else:
            holes, degree = self.holes(sight), completion.context.sh_degree
            settings = config.reconcile.at_most(degree)
            counted = [view.counted for view in completion.photographs]
            plans = list(each_view(kept)(lambda v, c: v.plan_appearance(kept, c), frozen, counted))
            observed = [first for first, *_ in budgets]
            refined, losses = reconcile(
                kept, sight.frozen, reference, holes, plans, observed, settings
            )
            drawings = [in_colours(plan, refined.sh) for plan in plans]
        return do_no_harm(refined, frozen, budgets, config.psnr_guard, drawings), losses

    def sight(self, completion: Completion, target: Camera, wide: Camera | None = None) -> Sight:
        """The scene as it stands, frozen at the target's wider camera, and the target's anchor.

        Without `wide` the target is widened where a hole reaches its edge; what its frame holds
        whole needs no more.
        """
        window = self.window(completion, target)
        if wide is not None:
            window = between(window.target, wide)
        sight = self.without_stereo(completion, window)
        if wide is None and is_enclosed(window.crop(self.holes(sight))):
            sight = self.without_stereo(completion, bordered(window.target, 0, 0))
        found = self.stereo(completion, sight.frozen.context, sight.window)
        return replace(sight, stereo=found)

    def without_stereo(self, completion: Completion, window: Window) -> Sight:
        """The same through a window, without what stereo among the photographs shows there."""
        frozen = self.renderer.freeze(completion.drawn, window.wide)
        anchor = self.anchor(completion, window.target)
        return Sight(
            completion, window, frozen, anchor, self.believed(completion, frozen, window.wide)
        )

    def anchor(self, completion: Completion, target: Camera) -> AnchorChoice:
        """Which photograph forms the stereo pair with the target, as the scene stands."""
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
        """What stereo among the photographs shows to the wider camera; None where nothing is
        doubted, or there is nothing to complete."""
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
        """The alpha of the scene as it stands, frozen at `camera`, as far as photographs support
        what this sees; None where nothing is doubted."""
        if completion.evidence is None:
            return None
        values = self.support(completion, completion.evidence, frozen, camera)
        return believed_alpha(frozen, values)

    def support(
        self, completion: Completion, evidence: Evidence, frozen: FrozenView, camera: Camera
    ) -> Float[Tensor, "n"]:
        """Support of the scene as it stands, as `camera` sees it. What was added has it all, and so
        has what it does not see."""
        sums, kept = weight_sums(frozen), completion.num_kept
        seen = in_context(completion, sums[:kept])
        found = support(evidence, seen, camera, self.config.trust_settings)
        values = torch.ones_like(sums)
        values[:kept] = of_kept(completion, found)
        return values

    def doubted(self, completion: Completion) -> Completion:
        """`completion` of a scene that was brought, before any target, and what the photographs
        show of it."""
        views, drawn = completion.photographs, completion.drawn
        frozen_views = self.at(completion, views)
        evidence = gather_evidence(drawn, views, frozen_views, self.config.trust_settings)
        return replace(completion, evidence=evidence)

    def without_unsupported(self, sight: Sight) -> Sight:
        """`sight` once what covers its holes, and no photograph shows or needs, is set aside.

        What is set aside leaves the scene, and is none of what the target is completed with.
        Without witnesses nothing is: what the context does not show, others may have shown.
        """
        completion, config = sight.completion, self.config.trust_settings
        if completion.evidence is None or not completion.witnesses or not config.prune:
            return sight
        doubtful = self.unseen_in_holes(sight, completion.evidence)
        if not doubtful.any():
            return sight
        taken = self.not_needed(completion, doubtful)
        if not taken.any():
            return sight
        again = self.without_stereo(without(completion, taken), sight.window)
        # Photographs, and what stereo makes of them, stay as they are.
        return replace(again, stereo=sight.stereo)

    def not_needed(self, completion: Completion, doubtful: Bool[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """The `doubtful` Gaussians of the scene as it stands that no photograph needs."""
        views, rest = completion.photographs, completion.drawn[~doubtful]
        cameras = [view.camera for view in views]
        around = each_view(rest)(partial(self.renderer.freeze, rest), cameras)
        self.frozen.forget()  # A scene without `doubtful` is to come.
        gone = not_needed(completion.drawn[doubtful], around, views)
        return doubtful.masked_scatter(doubtful, gone)

    def unseen_in_holes(self, sight: Sight, evidence: Evidence) -> Bool[Tensor, "n"]:
        """Which Gaussians of the scene as it stands cover holes and are shown by no photograph."""
        completion, camera = sight.completion, sight.window.wide
        drawn, holes = completion.drawn, self.holes(sight)
        everywhere = torch.ones_like(sight.alpha)
        layers = torch.stack([everywhere, holes.to(everywhere), 0 * everywhere], dim=-1)
        sums, covering, _ = sight.frozen.sums(layers).unbind(-1)
        of_context = (covering > MIN_COVER) & (drawn.generated == 0)
        kept = completion.num_kept
        seen = shown(evidence, in_context(completion, sums[:kept]), camera)
        of_context[:kept] &= of_kept(completion, seen) < UNSEEN
        of_context[kept:] = False
        return of_context

    def window(self, completion: Completion, target: Camera) -> Window:
        """The target and its wider camera, as wide as the generator can draw."""
        takes_margin = as_generator(self.generator).takes_margin
        return widened(completion.ranged(target), self.config.margin if takes_margin else 0.0)

    def holes(self, sight: Sight) -> Bool[Tensor, "h w"]:
        """Where the scene has a hole at the wider camera, by the settings of this completer."""
        return hole_mask(sight.alpha, self.config.holes)

    def wary_of_what_moved(self, completion: Completion) -> Completion:
        """`completion`, whose photographs say where others contradict them."""
        views, drawn = completion.views, contexts_of(self.at(completion, completion.views))
        masks = contradicted(views, drawn, self.config.dynamic_masks)
        return replace(
            completion,
            views=tuple(
                replace(view, contradicted=mask if mask.any() else None)
                for view, mask in zip(views, masks, strict=True)
            ),
        )

    def judged(self, completion: Completion) -> Completion:
        """`completion` before any target, with what its photographs ask of whatever is added."""
        config = self.config.psnr_guard
        tolerance = 0.0 if completion.evidence is not None else config.max_drop or 0.0
        drawn = contexts_of(self.at(completion, completion.photographs))
        budgets = tuple(
            error_budgets(
                view,
                render.image,
                hole_mask(render.alpha, self.config.holes),
                tolerance,
                config.max_ssim_drop,
            )
            for view, render in zip(completion.photographs, drawn, strict=True)
        )
        return replace(completion, budgets=budgets, begun=drawn[: len(completion.views)])

    def at(self, completion: Completion, views: Sequence[View]) -> tuple[FrozenView, ...]:
        """The scene as it stands, frozen at the cameras of photographs."""
        return self.frozen.of(completion, [view.camera for view in views])

    def small_renders(self, completion: Completion, cameras: Sequence[Camera]) -> Sequence[Render]:
        """What cameras of small images see of the scene as it stands, about."""
        return contexts_of(self.small.of(completion, cameras))


def ranged(view: View, near: float, far: float) -> View:
    """`view` with a depth range."""
    return replace(view, camera=replace(view.camera, near=near, far=far))


def without(completion: Completion, taken: Bool[Tensor, "n"]) -> Completion:
    """`completion` with more of its context set aside: `taken` of what is drawn of it."""
    before, gone = completion.set_aside, in_context(completion, taken[: completion.num_kept])
    aside = gone if before is None else before | gone
    return replace(completion, drawn=completion.drawn[~taken], set_aside=aside)


def in_context(completion: Completion, values: Shaped[Tensor, "kept"]) -> Shaped[Tensor, "m"]:
    """Values of what the scene keeps of its context, as values of all of this; 0 of the others."""
    aside = completion.set_aside
    if aside is None:
        return values
    return values.new_zeros(len(aside)).masked_scatter(~aside, values)


def of_kept(completion: Completion, values: Shaped[Tensor, "m"]) -> Shaped[Tensor, "kept"]:
    """Values of all of the context, as values of what the scene keeps of it."""
    aside = completion.set_aside
    return values if aside is None else values[~aside]


def check_numbers(scene: Gaussians | None, num_targets: int) -> None:
    """Refuse more targets than provenance can tell apart.

    Raises:
        InputError: where `scene` holds so many already that `num_targets` more do not fit.
    """
    given = 0 if scene is None or len(scene) == 0 else int(scene.generated.max())
    if given + num_targets > MAX_TARGETS:
        raise InputError(
            f"{num_targets} targets were given after {given} in the scene, and a .ply can tell "
            f"{MAX_TARGETS} apart; complete the scene in several runs."
        )


def nothing_added(sight: Sight, holes: Bool[Tensor, "h w"]) -> TargetCompletion:
    """The target before anything happened there."""
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
    """Why a target needs no completion, in a sentence; None where it does."""
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
    """`completion` after what happened at one more target."""
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
    """The scene as each of the frozen views shows it."""
    return tuple(frozen.context for frozen in frozen_views)


def nearest_views(camera: Camera, views: Sequence[View]) -> list[int]:
    """Indices of `views`, the ones taken closest to `camera` first."""
    return sorted(
        range(len(views)), key=lambda i: (views[i].camera.center - camera.center).norm().item()
    )


def notes_of(anchor_fallback: bool, affine: DepthAffine) -> tuple[str, ...]:
    """A sentence for each fallback that was taken."""
    notes = []
    if anchor_fallback:
        notes.append("Every view is turned too far; the least-turned one is the anchor.")
    if affine.contradicted:
        notes.append(
            "At the target the scene contradicted the depths that fit the anchor; they were fitted "
            "there instead."
        )
    if affine.refuted:
        notes.append(
            "At the target the scene contradicts the depths of what was synthesized: with "
            f"{affine.agreement:.0%} of what is seen of it they agree, and no other fit is better."
        )
    if affine.method == "median":
        notes.append("RANSAC found no trustworthy affine; the median depth ratio took its place.")
    if affine.method == "identity":
        notes.append("There was nothing to fit an affine to; depths were left as predicted.")
    return tuple(notes)


def check_values(views: Sequence[View], scene: Gaussians | None) -> None:
    """Refuse images and Gaussians of values that no stage can work with.

    Raises:
        InputError: where colours are outside of [0, 1], or the scene holds NaN or infinity.
    """
    for number, view in enumerate(views):
        low, high = (float(bound) for bound in view.image.aminmax())
        if not (low >= -COLOUR_SLACK and high <= 1 + COLOUR_SLACK):  # nor NaN
            raise InputError(
                f"The image of view {number} has values from {low:g} to {high:g}; colours in "
                "[0, 1] are needed."
            )
    parts = () if scene is None else (scene.means, scene.quats, scene.scales, scene.opacities)
    if not all(bool(part.isfinite().all()) for part in parts):
        raise InputError("The scene holds NaN or infinity; leave such Gaussians out.")


class Clock:
    """Wall time by stage, and `total`. That a stage goes on is shown where anything is."""

    def __init__(self, stages: Sequence[str] = STAGES) -> None:
        self._start = time.perf_counter()
        self._seconds = dict.fromkeys(stages, 0.0)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
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
        """Seconds of each stage so far, and of all of it."""
        return {**self._seconds, "total": time.perf_counter() - self._start}


def total(before: Mapping[str, float], more: Mapping[str, float]) -> dict[str, float]:
    """Seconds of both, stage by stage."""
    return {stage: before[stage] + more.get(stage, 0.0) for stage in before}
