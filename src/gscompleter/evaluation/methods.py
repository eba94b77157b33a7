"""Methods to compare, by name. All of them begin with the same context, and all that need a
synthesized image take the one that `full` takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.baselines.optimization import OptimizationConfig, optimize
from gscompleter.baselines.reggs import RegGSConfig, register_by_similarity
from gscompleter.completer import GSCompleter, ranged
from gscompleter.config import ABLATIONS, CompleterConfig, named_config
from gscompleter.errors import InputError
from gscompleter.generators import Generator
from gscompleter.geometry import widened
from gscompleter.reconstructors import Reconstructor
from gscompleter.render import Renderer
from gscompleter.stages.anchor import lift, select_anchor, synthesize
from gscompleter.stages.context import init_context
from gscompleter.stages.integration import HoleConfig, hole_mask
from gscompleter.types import Camera, Gaussians, SceneContext, View, merge


@dataclass(frozen=True)
class Parts:
    """The models and settings that every method shares."""

    reconstructor: Reconstructor
    generator: Generator
    renderer: Renderer
    seed: int = 0
    """Of everything random."""
    margin: float | None = None
    """Takes the place of `CompleterConfig.margin` where it is given: 0 for generators that know
    no more than the target's own image."""
    baseline_iterations: int | None = None
    """Most iterations of the baselines; their own numbers if None."""

    def config(self, name: str) -> CompleterConfig:
        """The settings called `name`, with our margin."""
        config = named_config(name)
        return config if self.margin is None else replace(config, margin=self.margin)

    def completer(self, name: str = "default") -> GSCompleter:
        """Our method with the settings called `name`."""
        config = self.config(name)
        return GSCompleter(self.reconstructor, self.generator, self.renderer, config, self.seed)

    def iterations(self, wanted: int) -> int:
        """`wanted`, or the most that is allowed."""
        return wanted if self.baseline_iterations is None else min(wanted, self.baseline_iterations)


@dataclass(frozen=True)
class Start:
    """Where every method begins."""

    views: tuple[View, ...]
    """The context photographs."""
    target: Camera
    context: Gaussians
    """What Ψ makes of them."""
    hole_mask: Bool[Tensor, "h w"]
    """True where the context has a hole, seen from the target."""
    seconds: float
    """What Ψ took."""


@dataclass(frozen=True)
class Prediction:
    """What a method made of the context."""

    context: Gaussians
    scene: Gaussians
    """The scene after it."""
    seconds: float
    """Wall time without that of the context."""
    hole_mask: Bool[Tensor, "h w"]
    """True where the context has a hole, seen from the target; the same for all methods."""
    added: Gaussians | None
    """What stands in `scene` beside the context; None where the context itself was changed."""
    notes: tuple[str, ...] = ()
    """Fallbacks that were taken, a sentence each."""


Method = Callable[[Start, Parts], Prediction]


def start_of(views: Sequence[View], target: Camera, parts: Parts) -> Start:
    """Reconstruct the context that all methods share.

    Cameras without a depth range get one that is estimated from the photographs.

    Raises:
        InputError: fewer than two views, or none that make a stereo pair.
    """
    if len(views) < 2:
        raise InputError(
            f"{len(views)} context view was given, and stereo needs at least 2; name more frames."
        )
    begin = time.perf_counter()
    near, far = parts.completer().depth_range(views, None)
    views = tuple(replace(view, camera=ranged(view.camera, near, far)) for view in views)
    target = ranged(target, near, far)
    context = init_context(parts.reconstructor, views)
    seconds = time.perf_counter() - begin
    holes = hole_mask(parts.renderer.render(context, target), HoleConfig())
    return Start(views, target, context, holes, seconds)


def nothing_added(start: Start, parts: Parts) -> Prediction:
    """Ψ alone."""
    none = start.context[:0]
    return Prediction(start.context, start.context, 0.0, start.hole_mask, none)


def completed_with(config: str) -> Method:
    """Our method with the settings called `config`."""

    def method(start: Start, parts: Parts) -> Prediction:
        done = parts.completer(config)(start.views, start.target, start.context)
        notes = done.targets[0].notes
        seconds = done.seconds["total"]
        return Prediction(start.context, done.scene, seconds, start.hole_mask, done.added, notes)

    return method


def optimized_with(config: OptimizationConfig) -> Method:
    """3DGS fitted to the photographs and the synthesized image, from the context on."""

    def method(start: Start, parts: Parts) -> Prediction:
        begin = time.perf_counter()
        views = [*start.views, synthesized(start, parts)]
        budget = replace(config, iterations=parts.iterations(config.iterations))
        fitted = optimize(start.context, views, parts.renderer, parts.seed, budget)
        seconds = time.perf_counter() - begin
        return Prediction(start.context, fitted.gaussians, seconds, start.hole_mask, None)

    return method


def registered_by_similarity(start: Start, parts: Parts) -> Prediction:
    """RegGS: all that was lifted, brought to the context by one similarity."""
    begin = time.perf_counter()
    reference = synthesized(start, parts)
    anchor = start.views[select_anchor(start.target, start.views).index]
    lifted = lift(parts.reconstructor, reference, anchor).gaussians
    config = RegGSConfig(iterations=parts.iterations(RegGSConfig.iterations))
    found = register_by_similarity(
        lifted, start.context, reference, parts.renderer, parts.seed, config
    )
    added = replace(found.gaussians, generated=torch.ones_like(found.gaussians.generated))
    scene = merge([start.context, added])
    seconds = time.perf_counter() - begin
    return Prediction(start.context, scene, seconds, start.hole_mask, added)


def synthesized(start: Start, parts: Parts) -> View:
    """The image of Φ that `full` takes, as far as the target sees it.

    Φ draws it with the margin of `full`, which is cut off, so that not a pixel differs.
    """
    target = start.target
    wide, left, top = widened(target, parts.config("default").margin)
    renders = tuple(parts.renderer.render(start.context, v.camera) for v in start.views)
    at_target = parts.renderer.render(start.context, wide)
    image = synthesize(parts.generator, wide, SceneContext(start.views, renders, at_target)).image
    return View(image[top : top + target.height, left : left + target.width], target)


BASELINES: dict[str, Method] = {
    "densify-100": optimized_with(OptimizationConfig(iterations=100)),
    "densify-800": optimized_with(OptimizationConfig(iterations=800)),
    "distill": optimized_with(OptimizationConfig(iterations=800, density_rounds=0)),
    "reggs": registered_by_similarity,
}
"""Methods that are not ours. They run on a CPU."""

METHODS: dict[str, Method] = {
    "context": nothing_added,
    "full": completed_with("default"),
    "paper": completed_with("paper"),
    **{name: completed_with(name) for name in ABLATIONS},
    "unconstrained": completed_with("3-dof"),
    **{f"paper/{name}": completed_with(f"paper/{name}") for name in ABLATIONS},
    **BASELINES,
}
"""Every method by its name, in the order of the tables."""


def check_methods(names: Sequence[str]) -> None:
    """Refuse names of no method, none at all, and the same one twice.

    Raises:
        InputError: where there is one.
    """
    known = ", ".join(name for name in METHODS if not name.startswith("paper/"))
    if not names:
        raise InputError(f"No method was named; choose one or more of {known}.")
    for name in names:
        if name not in METHODS:
            raise InputError(
                f"There is no method {name!r}; choose of {known} (paper/no-sa for an ablation of "
                "the paper's settings)."
            )
    if len(set(names)) < len(names):
        raise InputError(f"A method is named twice ({' '.join(names)}); name each once.")
