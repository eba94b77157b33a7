"""GSCompleter: the four stages of the paper, in order."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.config import CompleterConfig
from gscompleter.errors import InputError
from gscompleter.generators import BatchGenerator, Generator, load_generator
from gscompleter.geometry import same_camera, widened
from gscompleter.masks import dilate
from gscompleter.matching.depth_range import depth_range_of
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.render import FrozenView, Renderer, load_renderer
from gscompleter.stages.anchor import (
    Synthesized,
    lift,
    select_anchor,
    synthesize,
    synthesize_all,
)
from gscompleter.stages.context import depth_range_of_scene, init_context
from gscompleter.stages.free_space import respect_free_space
from gscompleter.stages.integration import (
    do_no_harm,
    error_with_loss,
    hole_mask,
    keep_in_holes,
    keep_near_holes,
    refine_opacities,
    squared_error,
)
from gscompleter.stages.registration import register
from gscompleter.types import (
    Camera,
    Completion,
    DepthAffine,
    Gaussians,
    SceneContext,
    TargetCompletion,
    View,
    merge,
)

MAX_TARGETS = 255
"""Provenance is a byte per Gaussian: 0 for observed, 1 to 255 for the targets."""


@dataclass(frozen=True)
class GSCompleter:
    """Completes a scene as seen from one or several target cameras.

    The defaults are the embedded models, which need no weights and no GPU.
    """

    reconstructor: Reconstructor = field(default_factory=lambda: load_reconstructor("plane-sweep"))
    """Ψ: views -> Gaussians and depth maps."""
    generator: Generator = field(default_factory=lambda: load_generator("warp-inpaint"))
    """Φ: nearest view and target camera -> image."""
    renderer: Renderer = field(default_factory=lambda: load_renderer("cpu"))
    """Draws Gaussians, differentiably."""
    config: CompleterConfig = CompleterConfig()
    """Settings of the stages."""
    seed: int = 0
    """Of the random samples that RANSAC draws."""

    def __call__(
        self,
        views: Sequence[View],
        target: Camera | Sequence[Camera],
        scene: Gaussians | None = None,
    ) -> Completion:
        """Complete what `views` never saw, as seen from `target`.

        Args:
            views: Photographs with their cameras: at least two, or one with `scene`.
            target: The camera (or cameras, completed one after the other into one scene; a
                generator that takes several at once is asked for their images before that).
            scene: Gaussians that are the context already, in the frame and unit of the cameras;
                they are kept as they are. Without it Ψ reconstructs the context from `views`.

        Raises:
            InputError: too few views, no baseline, too many targets, a scene nobody sees.
        """
        targets = [target] if isinstance(target, Camera) else list(target)
        first_number = 1 if scene is None or len(scene) == 0 else int(scene.generated.max()) + 1
        if not targets:
            raise InputError("No target camera was given; name at least one view to complete.")
        if first_number + len(targets) - 1 > MAX_TARGETS:
            raise InputError(
                f"{len(targets)} targets were given after {first_number - 1} in the scene, and a "
                f".ply can tell {MAX_TARGETS} apart; complete the scene in several runs."
            )
        if len(views) < (2 if scene is None else 1):
            raise InputError(
                f"{len(views)} context view was given, and stereo needs at least 2; name more "
                "frames, or bring a scene."
            )

        clock = Clock(STAGES)
        with clock("context"):
            near, far = self.depth_range(views, scene)
            views = [replace(v, camera=ranged(v.camera, near, far)) for v in views]
            targets = [ranged(camera, near, far) for camera in targets]
            context = init_context(self.reconstructor, views) if scene is None else scene
            allowed = self.allowed_errors(context, views)

        current = context
        results: list[TargetCompletion] = []
        at_once = self.generator.at_once if isinstance(self.generator, BatchGenerator) else 1
        for start in range(0, len(targets), at_once):
            together = targets[start : start + at_once]
            references = self.synthesize_together(current, views, together, clock)
            for camera, reference in zip(together, references, strict=True):
                number = first_number + len(results)
                result = self.complete_target(
                    current, views, camera, number, allowed, clock, reference
                )
                if len(result.added) > 0:
                    current = merge([current, result.added])
                results.append(result)
        return Completion(current, context, tuple(results), clock.seconds())

    def synthesize_together(
        self, scene: Gaussians, views: Sequence[View], targets: Sequence[Camera], clock: Clock
    ) -> list[Synthesized | None]:
        """Images of several targets from a generator that takes them all at once.

        None for a target at which there is nothing to complete, and for all where the generator
        takes one at a time: it then sees what was completed for the targets before.
        """
        if len(targets) < 2 or not isinstance(self.generator, BatchGenerator):
            return [None] * len(targets)
        asked: dict[int, tuple[Camera, SceneContext]] = {}
        with clock("context"):
            renders = tuple(self.renderer.render(scene, view.camera) for view in views)
            for i, target in enumerate(targets):
                wide, left, top = widened(target, self.config.margin)
                at_target = self.renderer.render(scene, wide)
                inner = at_target.cropped(left, top, target.width, target.height)
                if nothing_to_do(target, views, hole_mask(inner, self.config.holes)) is None:
                    asked[i] = (
                        wide,
                        SceneContext(tuple(views), renders, at_target, self.config.holes.max_alpha),
                    )
        with clock("generate"):
            found = synthesize_all(self.generator, list(asked.values())) if asked else []
        images = dict(zip(asked, found, strict=True))
        return [images.get(i) for i in range(len(targets))]

    def complete_target(
        self,
        scene: Gaussians,
        views: Sequence[View],
        target: Camera,
        number: int,
        allowed_errors: Sequence[float],
        clock: Clock,
        reference: Synthesized | None = None,
    ) -> TargetCompletion:
        """Stages 2 to 4 for one target: what it adds to `scene`, and how it came about.

        The generator is asked for the `reference` where there is none yet.
        """
        random = torch.Generator().manual_seed(self.seed)
        wide, left, top = widened(target, self.config.margin)
        with clock("context"):
            at_target = self.renderer.freeze(scene, wide)
            before = at_target.context.cropped(left, top, target.width, target.height)
            choice = select_anchor(target, views, self.config.anchor)
            anchor = views[choice.index]
        nothing = TargetCompletion(
            target=target,
            before=before,
            after=before,
            hole_mask=hole_mask(before, self.config.holes),
            reference=None,
            anchor=choice.index,
            anchor_fallback=choice.fallback,
            affine=DepthAffine(),
            added=scene[:0],
        )
        reason = nothing_to_do(target, views, nothing.hole_mask)
        if reason is not None:
            return replace(nothing, notes=(reason,))

        with clock("generate"):
            at_views = [self.renderer.freeze(scene, view.camera) for view in views]
            renders = tuple(frozen.context for frozen in at_views)
            known = SceneContext(
                tuple(views), renders, at_target.context, self.config.holes.max_alpha
            )
            if reference is None:
                reference = synthesize(self.generator, wide, known)

        with clock("lift"):
            lifted = lift(self.reconstructor, reference, anchor)
            wide_holes = hole_mask(at_target.context, self.config.holes)
            if self.config.holes.neighbourhood is not None:
                near_holes = dilate(wide_holes, self.config.holes.neighbourhood)
                lifted = keep_near_holes(lifted, near_holes)

        with clock("register"):
            registration = register(
                lifted,
                at_target,
                at_views[choice.index].context,
                reference,
                anchor.camera,
                self.renderer,
                random,
                self.config.registration,
                self.config.holes.max_alpha,
            )

        with clock("integrate"):
            mask = dilate(
                hole_mask(at_target.context, self.config.holes), self.config.holes.dilation
            )
            kept = keep_in_holes(registration.gaussians, lifted.pixel_index, mask, wide)
            kept, placed = respect_free_space(
                kept,
                wide,
                [view.camera for view in views],
                renders,
                self.config.registration.footprint,
                self.config.free_space,
            )
            kept = kept[placed]
            kept = replace(kept, generated=torch.full_like(kept.generated, number))
            refined, refine_losses = self.refine(kept, at_target, reference, at_views, views)
            added = do_no_harm(refined, at_views, views, allowed_errors, self.config.harm)
            after = self.renderer.render(merge([scene, added]), target)

        rows, columns = slice(top, top + target.height), slice(left, left + target.width)
        return replace(
            nothing,
            after=after,
            reference=View(reference.image[rows, columns], target),
            affine=registration.affine,
            added=added,
            losses={"register": registration.losses, "refine": refine_losses},
            notes=(*reference.notes, *notes_of(choice.fallback, registration.affine)),
        )

    def refine(
        self,
        added: Gaussians,
        at_target: FrozenView,
        reference: View,
        at_views: Sequence[FrozenView],
        views: Sequence[View],
    ) -> tuple[Gaussians, tuple[float, ...]]:
        """Refine the opacities of `added` against the context views nearest to the target."""
        nearest = sorted(
            range(len(views)),
            key=lambda i: (views[i].camera.center - reference.camera.center).norm().item(),
        )[: self.config.refine.num_views]
        return refine_opacities(
            added,
            at_target,
            reference,
            [at_views[i] for i in nearest],
            [views[i] for i in nearest],
            self.config.refine,
        )

    def depth_range(self, views: Sequence[View], scene: Gaussians | None) -> tuple[float, float]:
        """Near and far plane in scene units: as given, else estimated from what there is."""
        if scene is None:
            return depth_range_of(views)
        cameras = [view.camera for view in views]
        return depth_range_of(views, lambda _: depth_range_of_scene(scene, cameras, self.renderer))

    def allowed_errors(self, context: Gaussians, views: Sequence[View]) -> list[float]:
        """Largest mean squared error that each photograph may have once all is done."""
        renders = [self.renderer.render(context, view.camera).image for view in views]
        tolerance = self.config.harm.tolerance or 0.0
        return [
            error_with_loss(squared_error(image, view.image).item(), tolerance)
            for image, view in zip(renders, views, strict=True)
        ]


def nothing_to_do(target: Camera, views: Sequence[View], holes: Bool[Tensor, "h w"]) -> str | None:
    """Why a target needs no completion, in a sentence; None where it does."""
    if any(same_camera(target, view.camera) for view in views):
        return "The target is a context view: nothing to complete."
    if not holes.any():
        return "The scene has no hole here: nothing to complete."
    return None


def ranged(camera: Camera, near: float, far: float) -> Camera:
    """`camera` with the depth range of the scene."""
    return replace(camera, near=near, far=far)


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
    if affine.method == "median":
        notes.append("RANSAC found no trustworthy affine; the median depth ratio took its place.")
    if affine.method == "identity":
        notes.append("There was nothing to fit an affine to; depths were left as predicted.")
    return tuple(notes)


STAGES = ("context", "generate", "lift", "register", "integrate")
"""What a completion spends its time on."""


class Clock:
    """Wall time by stage."""

    def __init__(self, stages: Sequence[str] = ()) -> None:
        self._start = time.perf_counter()
        self._seconds = dict.fromkeys(stages, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            spent = time.perf_counter() - start
            self._seconds[stage] = self._seconds.get(stage, 0.0) + spent

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage so far, and of all of it."""
        return {**self._seconds, "total": time.perf_counter() - self._start}
