"""Methods to compare by name; all share the initial scene and the reference image."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch

from gscompleter.completer import GSCompleter
from gscompleter.config import ABLATIONS, get_named_config
from gscompleter.config.settings import COVERED
from gscompleter.evaluation.baselines.optimization import OptimizationConfig, optimize
from gscompleter.evaluation.baselines.reggs import RegGSConfig, register_by_similarity
from gscompleter.generators import Generator
from gscompleter.numerics.geometry import add_near_plane
from gscompleter.reconstructors import Reconstructor
from gscompleter.render.protocols import Renderer
from gscompleter.stages.lift import lift_pair
from gscompleter.stages.select_anchor import select_anchor
from gscompleter.state import Completion
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.timing import add_seconds, record_seconds, timed_stage
from gscompleter.types import Camera, Gaussians, View, merge
from gscompleter.virtual_capture.around_target import choose_cameras_around
from gscompleter.virtual_capture.render_views import render_views


@dataclass(frozen=True)
class Models:
    """The models that all methods share."""

    reconstructor: Reconstructor
    generator: Generator
    renderer: Renderer
    seed: int = 0
    baseline_iterations: int | None = None
    """Largest number of iterations of the baselines, for a fast trial; None keeps their own."""

    def make_completer(self, config: str = "default") -> GSCompleter:
        """Make our completer with the named config.

        It adds nothing but at targets: Ψ made the scene of the same photographs, which show nothing
        that it lacks.
        """
        settings = replace(get_named_config(config), add_observed=False)
        return GSCompleter(self.reconstructor, self.generator, self.renderer, settings, self.seed)

    def limit_iterations(self, num_iterations: int) -> int:
        """Limit a number of iterations to `baseline_iterations`."""
        if self.baseline_iterations is None:
            return num_iterations
        return min(num_iterations, self.baseline_iterations)


@dataclass(frozen=True)
class Prediction:
    """The scene that a method leaves for one target."""

    scene: Gaussians
    added: Gaussians | None
    """Gaussians that the method added, or None if it changed existing ones."""
    seconds: Mapping[str, float]
    """Wall time by stage, without the reconstruction of the context, and `total`."""
    anchor: int | None = None
    """Index of the anchor view, or None if nothing is lifted or a render is the anchor."""
    anchor_fallback: bool = False
    """True if all views were rotated too far and the least rotated one was chosen."""
    registered: Gaussians | None = None
    """All lifted Gaussians after registration and before filtering; None if nothing is lifted."""
    peak_bytes: int | None = None
    """Peak memory in bytes, or None if the system does not report it."""


Method = Callable[[Completion, Camera, Models], Prediction]
"""Function of the current scene with its photographs, the target and the models."""


def keep_scene(state: Completion, target: Camera, models: Models) -> Prediction:
    """Return the scene unchanged."""
    return Prediction(state.scene, state.scene[:0], {"total": 0.0})


def make_completion_method(config: str) -> Method:
    """Make a method of our completer with the named config."""

    def method(state: Completion, target: Camera, models: Models) -> Prediction:
        completer = replace(models.make_completer(config), keep_registered=True)
        # `state` was begun with another config, whose guard may have masked the photographs.
        views = [replace(view, dynamic_mask=None) for view in state.views]
        return predict(completer.advance(completer.begin(views, state.scene), target))

    return method


def predict(done: Completion) -> Prediction:
    """Return what the completion of a single target leaves."""
    (result,) = done.targets
    return Prediction(
        scene=done.scene,
        added=result.added,
        seconds=done.seconds,
        anchor=result.anchor,
        anchor_fallback=result.anchor_fallback,
        registered=result.registered,
    )


def complete_bare(state: Completion, target: Camera, models: Models) -> Prediction:
    """Complete the scene without its photographs, from renders of it around the target.

    Raise InputError if no camera around the target sees what is beside its hole.
    """
    completer = replace(models.make_completer("bare"), keep_registered=True)
    # The target has the depth range of the photographs, which is not known without them.
    unranged = replace(target, near=None, far=None)
    with record_seconds() as seconds, timed_stage("context"):
        camera = add_near_plane(unranged, state.scene.means)
        holes = models.renderer.render(state.scene, camera).alpha < COVERED
        cameras = choose_cameras_around(state.scene, unranged, models.renderer, holes)
        views = render_views(state.scene, cameras, models.renderer)
    if not holes.any():
        return Prediction(state.scene, state.scene[:0], seconds)
    if not views:
        raise InputError(
            "No camera around the target sees what is beside its hole, so that there is nothing to "
            "complete it from; leave out the method bare, or choose another target."
        )
    done = completer.advance(completer.begin(views, state.scene), unranged)
    prediction = predict(replace(done, seconds=add_seconds(done.seconds, seconds)))
    # The anchor is a render, and not one of the photographs of the state.
    return replace(prediction, anchor=None)


def make_steps_method(steps: int) -> Method:
    """Make the paper's method with a number of denoising steps of its generator."""
    complete = make_completion_method("paper")

    def method(state: Completion, target: Camera, models: Models) -> Prediction:
        check_steps((f"steps-{steps}",), models.generator)
        generator: Any = models.generator
        return complete(state, target, replace(models, generator=replace(generator, steps=steps)))

    return method


def make_optimization_method(config: OptimizationConfig) -> Method:
    """Make a method that optimizes the scene on the photographs and the reference."""

    def method(state: Completion, target: Camera, models: Models) -> Prediction:
        budget = replace(config, iterations=models.limit_iterations(config.iterations))
        with record_seconds(()) as seconds:
            views = [*state.views, synthesize_reference(state, target, models)]
            with timed_stage("optimize"):
                fitted = optimize(state.scene, views, models.renderer, models.seed, budget)
        return Prediction(fitted, None, seconds)

    return method


def synthesize_reference(state: Completion, target: Camera, models: Models) -> View:
    """Synthesize the image at a target, without padding, even if there is no hole."""
    completer = models.make_completer()
    with timed_stage("generate"):
        view = completer.observe(state, target)
        return completer.synthesize([view])[0].crop(view.camera)


def complete_by_similarity(state: Completion, target: Camera, models: Models) -> Prediction:
    """Add all lifted Gaussians, registered to the scene by one similarity (RegGS)."""
    config = RegGSConfig(iterations=models.limit_iterations(RegGSConfig.iterations))
    with record_seconds(()) as seconds:
        reference = synthesize_reference(state, target, models)
        anchor = select_anchor(reference.camera, state.views)
        with timed_stage("lift"):
            pair = lift_pair(models.reconstructor, reference, state.views[anchor.index])
        with timed_stage("register"):
            added = register_by_similarity(
                pair.gaussians, state.scene, reference, models.renderer, models.seed, config
            )
    scene = merge([state.scene, added])
    return Prediction(
        scene,
        added,
        seconds,
        anchor=anchor.index,
        anchor_fallback=anchor.is_fallback,
        registered=added,
    )


def mark_target(prediction: Prediction, number: int, before: Gaussians) -> Prediction:
    """Label the Gaussians added to `before` as generated for target `number`.

    A method sees one target at a time, and so labels all of its additions alike.
    """
    if prediction.added is None:
        return prediction
    generated = torch.full_like(prediction.added.generated, number)
    added = replace(prediction.added, generated=generated)
    return replace(prediction, added=added, scene=merge([before, added]))


SCENE_CHANGING: dict[str, Method] = {
    "densify-100": make_optimization_method(OptimizationConfig(iterations=100)),
    "densify-800": make_optimization_method(OptimizationConfig(iterations=800)),
    "distill": make_optimization_method(OptimizationConfig(iterations=800, density_rounds=0)),
}
"""Methods that change existing Gaussians and therefore cannot run a sequence."""

BASELINES: dict[str, Method] = {**SCENE_CHANGING, "reggs": complete_by_similarity}
"""Methods of others."""

STEPS_METHODS: dict[str, Method] = {
    f"steps-{steps}": make_steps_method(steps) for steps in (2, 4, 8, 16)
}
"""The paper's method with other numbers of denoising steps."""

ABLATION_CONFIGS = {
    "unconstrained" if config == "3-dof" else config: config for config in ABLATIONS
}
"""Config of each ablation by the name of its method. They differ for `3-dof`, with which the paper
compares its constraint to rays, under the name of what it lacks."""

METHODS: dict[str, Method] = {
    "context": keep_scene,
    "full": make_completion_method("default"),
    "bare": complete_bare,
    "paper": make_completion_method("paper"),
    **{name: make_completion_method(config) for name, config in ABLATION_CONFIGS.items()},
    **{
        f"paper/{name}": make_completion_method(f"paper/{config}")
        for name, config in ABLATION_CONFIGS.items()
    },
    **STEPS_METHODS,
    **BASELINES,
}
"""All methods by name, in the order of the tables."""

METHOD_GROUPS: dict[str, tuple[str, ...]] = {
    "ablations": tuple(ABLATION_CONFIGS),
    "baselines": tuple(BASELINES),
    "all": ("context", "full", "paper", *ABLATION_CONFIGS, *BASELINES),
}
"""Names that stand for several methods. `all` leaves out those with another input (bare), another
generator (steps-N), or the paper's settings with a change (paper/NAME)."""


def expand_methods(names: Sequence[str]) -> tuple[str, ...]:
    """Replace groups by their methods and drop duplicates; raise as `check_methods`."""
    chosen = dict.fromkeys(method for name in names for method in METHOD_GROUPS.get(name, (name,)))
    check_methods(tuple(chosen))
    return tuple(chosen)


def check_methods(names: Sequence[str], num_targets: int = 1) -> None:
    """Raise InputError for no or unknown names, and methods that cannot do that many targets."""
    known = ", ".join([*METHOD_GROUPS, *(n for n in METHODS if not n.startswith("paper/"))])
    if not names:
        raise InputError(f"No method was named; choose one or more of {known}.")
    for name in names:
        if name not in METHODS:
            raise InputError(
                f"There is no method '{quote_value(name)}'; choose one of {known} (paper/no-sa for "
                "an ablation of the paper's settings)."
            )
        if num_targets > 1 and name in SCENE_CHANGING:
            raise InputError(
                f"The method {name!r} changes existing Gaussians, and a sequence can only add new "
                "ones; choose one of context, full, bare, paper, an ablation of full or paper, "
                f"{', '.join(STEPS_METHODS)}, and reggs."
            )


def check_steps(names: Sequence[str], generator: Generator) -> None:
    """Raise InputError for a method that sets denoising steps which the generator does not have."""
    # They are set in a copy, so that the generator has to be a dataclass with such a field.
    has_steps = is_dataclass(generator) and any(
        field.name == "steps" and field.init for field in fields(generator)
    )
    for name in names:
        if name in STEPS_METHODS and not has_steps:
            raise InputError(
                f"The method {name} needs a generator with denoising steps; choose pe-field, or "
                "leave the method out."
            )
