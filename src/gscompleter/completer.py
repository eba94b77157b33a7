"""GSCompleter: complete a scene, target after target (paper, Sec. III)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress

import torch

from gscompleter.config import CompleterConfig
from gscompleter.config.settings import validate
from gscompleter.generators import (
    FunctionGenerator,
    Generator,
    ImageFunction,
    as_generator,
    load_generator,
)
from gscompleter.guards import accept_at, prepare_guards
from gscompleter.numerics.geometry import count_outside, pad_camera, pad_like
from gscompleter.numerics.given_geometry import GivenGeometry, count_at_given_depth
from gscompleter.numerics.image_ops import is_enclosed, keep_thin
from gscompleter.numerics.value_checks import (
    check_camera,
    check_gaussians,
    check_inputs,
    check_row_mask,
)
from gscompleter.parts import (
    EarlierWork,
    Part,
    PartOrigin,
    check_target_ids,
    find_last_target_id,
    make_part,
)
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.reconstructors.depth_predictors import predict_nothing
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.stages.add_observed import add_observed
from gscompleter.stages.additions import Additions
from gscompleter.stages.align_depth import align_depth
from gscompleter.stages.close_gaps import (
    are_worth_closing,
    continue_surfaces,
    displace_camera,
    view_gaps,
)
from gscompleter.stages.context import InitialContext, choose_config, init_context
from gscompleter.stages.context_geometry import init_with_geometry
from gscompleter.stages.fade_border import fade_border
from gscompleter.stages.filter_holes import filter_holes
from gscompleter.stages.find_unfilled import find_unfilled
from gscompleter.stages.given_geometry import add_geometry_depth, check_geometry
from gscompleter.stages.lift import lift
from gscompleter.stages.new_photos import find_new_photos, recolor_to_photos
from gscompleter.stages.recolor import recolor
from gscompleter.stages.refine import keep_as_it_is, refine
from gscompleter.stages.refusals import explain_skip
from gscompleter.stages.register import register_along_rays
from gscompleter.stages.register_paper import register_as_paper
from gscompleter.stages.remake_scene import remake_scene
from gscompleter.stages.replace_contested import find_contested, let_step_aside, return_needed
from gscompleter.stages.result import TargetOutcome, make_unchanged_result
from gscompleter.stages.select_anchor import Anchor, choose_anchor
from gscompleter.stages.synthesize import GeneratedView, make_generator_input, synthesize
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.state import Completion, Photo
from gscompleter.system.errors import InputError
from gscompleter.system.progress import show_in_notebook, track
from gscompleter.system.tensor_checks import describe, is_whole_number
from gscompleter.system.timing import add_seconds, record_seconds, timed_stage
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.target_result import TargetResult
from gscompleter.trust import Trust
from gscompleter.trust.photometric import load_trust
from gscompleter.types import Camera, DepthAffine, Gaussians, PaddedCamera, View, merge

MAX_SEED = 2**62
"""Levels and rounds add to the seed, which has 64 bits."""
REGISTRATIONS = {"paper": register_as_paper, "ours": register_along_rays}
"""Registration by the name that a preset gives it."""


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
    config: CompleterConfig | None = None
    """Settings, or None for the preset that fits the input: `CompleterConfig.splat()` for a scene
    with check views, `CompleterConfig()` for all others."""
    seed: int = 0
    """Seed of the RANSAC samples."""
    keep_registered: bool = False
    """True to keep all registered Gaussians in each result, for evaluation."""

    def __post_init__(self) -> None:
        """Raise InputError for a model that cannot be called, or a setting out of range."""
        if not callable(self.reconstructor) or isinstance(self.reconstructor, type):
            raise InputError(
                "The reconstructor has to be a function of views, such as gsc.load_reconstructor "
                f"returns, and is {describe(self.reconstructor)}."
            )
        as_generator(self.generator)
        if not isinstance(self.renderer, Renderer) or isinstance(self.renderer, type):
            raise InputError(
                "The renderer has to be one that gsc.load_renderer returns, and is "
                f"{describe(self.renderer)}."
            )
        if self.config is not None and not isinstance(self.config, CompleterConfig):
            raise InputError(
                "The config has to be a CompleterConfig, such as CompleterConfig.paper() or "
                f"CompleterConfig.splat(), and is {describe(self.config)}."
            )
        if not is_whole_number(self.seed) or not 0 <= self.seed < MAX_SEED:
            raise InputError(
                f"The seed has to be a whole number from 0 to 2^62, and is {describe(self.seed)}."
            )
        validate(self.config or CompleterConfig(), "config.")

    @cached_property
    def scenes(self) -> SceneRenderer:
        """The renderer, with scenes frozen at the cameras that are visited again."""
        return SceneRenderer(self.renderer)

    @show_in_notebook()
    @run_in_plain_torch
    def __call__(
        self,
        views: Sequence[View],
        target: Camera | Sequence[Camera],
        scene: Gaussians | None = None,
        check_views: Sequence[View] | None = None,
        geometry: GivenGeometry | None = None,
    ) -> Completion:
        """Complete what `views` never saw, as seen from one or several targets.

        Args:
            views: Posed context views: at least two, or one if `scene` is given. Views with frame
                numbers are sorted by them.
            target: Target cameras, completed one after the other into one scene.
            scene: Gaussians to complete, in the frame and unit of the cameras. If None, Ψ
                reconstructs the context from `views`.
            check_views: Further photographs of `scene` that must not get worse. With them the scene
                is trusted only as far as the photographs confirm it. Without `scene`, photographs
                to which a Ψ such as plane-sweep fits the scene besides `views`, from three of these
                on.
            geometry: A scan or mesh (`load_geometry`), in the frame and unit of the cameras or in
                one of its own, from which it is moved to where the scene shows the same. It gives
                depth where photographs show none, as far as it agrees with what they show.

        Raises:
            InputError: Too few views, no baseline, too many targets, no view sees the scene, no
                target sees enough of it, or the geometry contradicts the photographs.
        """
        targets = list_targets(target)
        if scene is not None:
            check_gaussians(scene, "The scene")
            check_target_ids(find_last_target_id(scene), len(targets))
        begun = self.begin(views, scene, check_views, targets, geometry=geometry)
        return self.complete(begun, targets)

    @show_in_notebook()
    @run_in_plain_torch
    def complete(self, state: Completion, targets: Sequence[Camera]) -> Completion:
        """Complete a begun scene for targets, one group after the other.

        Raises InputError if every target is refused.
        """
        check_state(state)
        check_target_list(targets)
        batch = as_generator(self.generator).max_batch_size
        counted_as = "target" if batch == 1 else "group of targets"
        for start in track(range(0, len(targets), batch), counted_as):
            state = self.advance_batch(state, targets[start : start + batch])
        check_any_completed(state)
        return state

    @show_in_notebook()
    @run_in_plain_torch
    def begin(
        self,
        views: Sequence[View],
        scene: Gaussians | None = None,
        check_views: Sequence[View] | None = None,
        targets: Sequence[Camera] = (),
        earlier: EarlierWork = EarlierWork(),
        geometry: GivenGeometry | None = None,
        has_scene_range: bool = False,
    ) -> Completion:
        """Initialize the context (stage 1; paper, Eq. 5); arguments and errors as in `__call__`.

        The LOD proxy of a large scene is made fine enough for photographs and known targets.
        `earlier` marks what earlier commands made of `scene`. `has_scene_range` is True if near and
        far of the views are those that `find_scene_range` found, so that they are not looked for
        again.
        """
        check_inputs(views, scene, check_views or (), targets)
        check_row_mask(earlier.invented, scene, "The mask of what was invented")
        check_row_mask(earlier.lifted, scene, "The mask of what was lifted")
        check_row_mask(earlier.remade, scene, "The mask of what is made anew")
        config = choose_config(self.config, scene, check_views)
        if geometry is not None:
            check_geometry(geometry, config)

        # The authors' Ψ makes the same scene for all targets.
        favored = () if config.registration_method == "paper" else targets

        def init(photographs: Sequence[View]) -> InitialContext:
            return init_context(
                self.reconstructor,
                photographs,
                scene,
                check_views or (),
                targets,
                favored,
                self.renderer,
                # Depth of geometry may reach farther than what photographs showed before.
                has_scene_range and geometry is None,
            )

        with record_seconds() as seconds, timed_stage("context"):
            context = (
                init(views)
                if geometry is None
                else init_with_geometry(geometry, views, scene is not None, init, self.scenes)
            )
            photos = tuple(Photo(view) for view in context.views)
            state = Completion(
                config,
                context.source,
                context.source.rendered,
                photos,
                len(views),
                Trust(),
                is_given=scene is not None,
                seed=self.seed,
                context_notes=context.notes,
                geometry=context.geometry,
                exposure_gains=context.exposure_gains,
                models=self.name_models(),
            )
            # What earlier commands made steps aside where photographs show something else, so that
            # nobody takes it for a part of the scene that they contradict.
            contested = find_contested(state, earlier, self.scenes)
            remade = remake_scene(
                self.reconstructor, state, views, earlier, contested, self.renderer, has_scene_range
            )
            if remade is not None:
                state = remade
            else:
                state = let_step_aside(state, contested)
                # Guards measure the scene as it was given, so before anything changes.
                state = prepare_guards(state, self.scenes)
                # The order of evidence: what photographs show goes in first, what the scene shows
                # is kept, and Φ invents only the rest (decision 051).
                state = add_observed(self.reconstructor, state, self.scenes)
                state = return_needed(state, contested, self.scenes)
            if state.num_observed or contested is not None:
                # What photographs gained by it has to stay, too.
                state = prepare_guards(state, self.scenes)

            # Photographs that a splat was not trained on say nothing about the trust in it. They
            # are targets themselves, before all others (decision 041).
            photographs = [photo.view for photo in state.photos]
            new = find_new_photos(config, state.parts, photographs, self.scenes)
            trained = [view for index, view in enumerate(photographs) if index not in new]
            trust = load_trust(config, state.parts, trained, self.scenes)
            state = replace(state, trust=trust)
            state = recolor_to_photos(state, [photographs[i] for i in new], self.scenes)
        return replace(state, seconds=seconds)

    def name_models(self) -> dict[str, str]:
        """Name Ψ, the depth that helps it, and Φ, for the record of what is invented."""
        depth = getattr(self.reconstructor, "predict_depth", predict_nothing)
        phi = self.generator
        models = {
            "reconstructor": self.reconstructor,
            "depth": None if depth is predict_nothing else depth,
            "generator": phi.function if isinstance(phi, FunctionGenerator) else phi,
        }
        return {key: name_model(model) for key, model in models.items() if model is not None}

    @show_in_notebook()
    @run_in_plain_torch
    def advance(
        self, state: Completion, target: Camera, reference: GeneratedView | None = None
    ) -> Completion:
        """Complete the scene for one more target (stages 2 to 4 of the paper).

        `reference` is the image at the target if it was synthesized in advance, padded if Φ
        supports it.
        """
        check_state(state)
        with record_seconds() as seconds:
            view = self.observe(state, target, reference)
            anchor = choose_anchor(view)  # Sec. III-D
            unchanged = make_unchanged_result(view, anchor)
            outcome = TargetOutcome(state, unchanged)
            if not unchanged.skip_reason:
                outcome = self.fill_holes(anchor, reference, unchanged)
        after = outcome.state
        added = [part for part in outcome.parts if len(part)]
        return replace(
            after,
            added_parts=(*after.added_parts, *added),
            targets=(*after.targets, outcome.result),
            seconds=add_seconds(after.seconds, seconds),
            is_restored=False,
        )

    def fill_holes(
        self, anchor: Anchor, reference: GeneratedView | None, unchanged: TargetResult
    ) -> TargetOutcome:
        """Fill the holes of the target of an anchor; `reference` is as in `advance`.

        `unchanged` is the result of a target that stays as it is.
        """
        view = anchor.target
        state = view.state
        # Seeded anew for each target, so that its result does not depend on how many came before.
        rng = torch.Generator().manual_seed(self.seed)
        # Stages 2 to 4 of the paper, an equation a line.
        image = reference or self.synthesize([view])[0]  # Eq. 6
        image, use = add_geometry_depth(image, view)
        lifted = lift(self.reconstructor, image, anchor, view)  # Eq. 7
        affine = align_depth(lifted, anchor, view, rng)  # Eq. 8
        register = REGISTRATIONS[state.config.registration_method]
        moved = register(lifted, affine, image, anchor, view)  # Eq. 9 to 11
        in_holes = filter_holes(moved, view)  # Eq. 12
        origin = PartOrigin("target", state.next_target_id)
        candidates = Additions.begin(origin, "lift", lifted.gaussians)
        candidates = candidates.then("register", moved.gaussians).then("filter", in_holes)
        filled = accept_at(view, candidates, image, affine, refine)  # Eq. 13
        faded = fade_border(filled.gaussians, view)
        part = make_part(origin, faded)

        # Not in the paper: what covers the target without being trusted takes new colours, and gaps
        # that a camera beside the target would see are closed.
        recolored = recolor(image, view, origin)
        closing = self.close_gaps(recolored.state, view, part)
        added = merge([part.gaussians, closing.gaussians])
        after = recolored.frozen.composite(added)
        result = replace(
            unchanged,
            after=after.crop(view.camera),
            added=added,
            unfilled=find_unfilled(after, filled.steps, view),
            reference=image.crop(view.camera),
            affine=affine,
            losses={"register": moved.losses, "refine": filled.losses},
            registered=moved.gaussians if self.keep_registered else None,
            num_outside=count_outside(added, view.camera.target) if state.is_given else 0,
            num_recolored=len(recolored.rows),
            synthesis_notes=image.notes,
            lift_notes=lifted.notes,
            geometry=replace(use, added=count_at_given_depth(added, image)),
            painter=image.painter,
            rejection=filled.rejection,
        )
        return TargetOutcome(recolored.state, result, (part, closing))

    def close_gaps(self, state: Completion, target: TargetView, added: Part) -> Part:
        """Return what closes the thin gaps beside a target, for which `added` is added.

        None are closed where nothing was added, or in the paper.
        """
        origin = PartOrigin("gap", state.next_target_id)
        nothing = make_part(origin, added.gaussians[:0])
        config = state.config.gaps
        if config.displacement == 0 or len(added) == 0:
            return nothing
        # The target is not counted as completed yet: what is added here gets its id, and has to be
        # content with its budgets.
        photos = tuple(
            replace(photo, budgets=budgets)
            for photo, budgets in zip(state.photos, target.budgets, strict=True)
        )
        state = replace(
            state,
            added_parts=(*state.added_parts, added),
            photos=photos,
            filled_target=target.camera.target,
        )
        closed = [nothing]
        for camera in displace_camera(target.camera.target, state.views, config.displacement):
            # What the camera before it closed is not a gap any more.
            view = view_gaps(state, camera, self.scenes, config)
            gaps = keep_thin(view.empty)
            if not are_worth_closing(gaps):
                continue
            image, continued = continue_surfaces(view, gaps)
            candidates = Additions.begin(origin, "continue", continued)
            part = accept_at(view, candidates, image, DepthAffine(), keep_as_it_is).to_part()
            state = replace(state, added_parts=(*state.added_parts, part))
            closed.append(part)
        return make_part(origin, merge([part.gaussians for part in closed]))

    @run_in_plain_torch
    def advance_batch(self, state: Completion, targets: Sequence[Camera]) -> Completion:
        """Complete several targets, whose images Φ synthesizes in one call.

        All images are of the scene before the first of these targets.
        """
        check_state(state)
        check_target_list(targets)
        if len(targets) == 1:
            return self.advance(state, targets[0])
        with record_seconds() as seconds:
            views = [self.observe(state, target) for target in targets]
            is_open = [not explain_skip(view) for view in views]
            images = iter(self.synthesize(list(compress(views, is_open))))
        state = replace(state, seconds=add_seconds(state.seconds, seconds))
        for target, has_image in zip(targets, is_open, strict=True):
            state = self.advance(state, target, next(images) if has_image else None)
        return state

    @run_in_plain_torch
    @timed_stage("context")
    def observe(
        self, state: Completion, target: Camera, reference: View | None = None
    ) -> TargetView:
        """Render the scene at a target, padded if a hole reaches the border of the image.

        A reference that was synthesized in advance determines the padding by its camera.
        """
        check_state(state)
        check_camera(target, "The target")
        camera = self.pad_target(state, target, reference)
        view = render_target(state, camera, self.scenes)
        # A camera that moves on from the target meets the next hole at the border of its image
        # (decision 001). Holes that do not reach it need no padding.
        if reference is None and camera.is_padded and is_enclosed(camera.crop(view.holes)):
            view = render_target(state, pad_camera(camera.target, 0.0), self.scenes)
        return view

    def pad_target(
        self, state: Completion, target: Camera, reference: View | None = None
    ) -> PaddedCamera:
        """Pad a target camera as its reference, else by as much as the settings and Φ allow."""
        ranged = state.with_depth_range(target)
        if reference is not None:
            return pad_like(ranged, reference.camera)
        # `begin` has chosen the margin.
        margin = state.config.margin or 0.0
        can_pad = as_generator(self.generator).supports_padding
        return pad_camera(ranged, margin if can_pad else 0.0)

    @timed_stage("generate")
    def synthesize(self, views: Sequence[TargetView]) -> list[GeneratedView]:
        """Synthesize the image of each padded target (paper, Eq. 6)."""
        if not views:
            return []
        inputs = [(view.camera.padded, make_generator_input(view)) for view in views]
        return synthesize(self.generator, inputs, views[0].state.config.synthesis)


def name_model(model: object) -> str:
    """Name a model by its own `name`, or that of its function or class."""
    own = getattr(model, "name", None) or getattr(model, "__name__", None)
    return own if isinstance(own, str) else type(model).__name__


def check_state(state: object) -> None:
    """Raise InputError for a value in place of a completion."""
    if not isinstance(state, Completion):
        raise InputError(
            "The state has to be a Completion, such as GSCompleter.begin returns, and is "
            f"{describe(state)}."
        )


def check_target_list(targets: object) -> None:
    """Raise InputError unless these are a list; its cameras are checked one by one."""
    if not isinstance(targets, Sequence) or isinstance(targets, str):
        raise InputError(f"The targets have to be a list of cameras, and are {describe(targets)}.")


def list_targets(target: object) -> list[Camera]:
    """List one or several target cameras; raise InputError for anything else or none."""
    targets = [target] if isinstance(target, Camera) else target
    if not isinstance(targets, (list, tuple)):
        raise InputError(
            "The target has to be a Camera, such as gsc.load_camera returns, or a list of them, "
            f"and is {describe(target)}."
        )
    if not targets:
        raise InputError("No target camera was given; name at least one view to complete.")
    return list(targets)


def check_any_completed(state: Completion) -> None:
    """Raise InputError with the reason of the first target if every target was refused."""
    reasons = [result.refusal for result in state.targets]
    if all(reasons):
        more = "" if len(reasons) == 1 else f" The same holds for the other {len(reasons) - 1}."
        raise InputError(f"{reasons[0]}{more}", "target")
