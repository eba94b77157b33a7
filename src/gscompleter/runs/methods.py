"""Methods to compare, by name. All of them begin with the same context, and all that need a
synthesized image take the one that `full` takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.baselines.optimization import OptimizationConfig, optimize
from gscompleter.baselines.reggs import RegGSConfig, register_by_similarity
from gscompleter.completer import Clock, GSCompleter
from gscompleter.config import ABLATIONS, HoleConfig, named_config
from gscompleter.errors import InputError
from gscompleter.generators import Generator
from gscompleter.metrics.scores import Outcome
from gscompleter.reconstructors import Reconstructor
from gscompleter.render import Renderer
from gscompleter.stages.anchor import lift, select_anchor
from gscompleter.stages.integration import hole_mask
from gscompleter.types import Camera, Gaussians, View, merge


@dataclass(frozen=True)
class Parts:
    """The models and settings that every method shares."""

    reconstructor: Reconstructor
    generator: Generator
    renderer: Renderer
    seed: int = 0
    """Of everything random."""
    baseline_iterations: int | None = None
    """Most iterations of the baselines; their own numbers if None."""

    def completer(self, name: str = "default") -> GSCompleter:
        """Our method with the settings called `name`."""
        config = named_config(name)
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


Method = Callable[[Start, Parts], Outcome]


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
    begun = parts.completer().begin(views)
    target = begun.ranged(target)
    holes = hole_mask(parts.renderer.render(begun.scene, target), HoleConfig())
    return Start(begun.views, target, begun.scene, holes, begun.seconds["total"])


def nothing_added(start: Start, parts: Parts) -> Outcome:
    """Ψ alone."""
    none = start.context[:0]
    return Outcome(start.context, start.context, none, start.hole_mask, {"total": 0.0})


def completed_with(config: str) -> Method:
    """Our method with the settings called `config`."""

    def method(start: Start, parts: Parts) -> Outcome:
        done = parts.completer(config)(start.views, start.target, start.context)
        notes = done.targets[0].notes
        return Outcome(
            start.context, done.scene, done.added, start.hole_mask, dict(done.seconds), notes
        )

    return method


def optimized_with(config: OptimizationConfig) -> Method:
    """3DGS fitted to the photographs and the synthesized image, from the context on."""

    def method(start: Start, parts: Parts) -> Outcome:
        clock = Clock(())
        with clock("generate"):
            views = [*start.views, synthesized(start, parts)]
        budget = replace(config, iterations=parts.iterations(config.iterations))
        with clock("optimize"):
            fitted = optimize(start.context, views, parts.renderer, parts.seed, budget)
        return Outcome(start.context, fitted.gaussians, None, start.hole_mask, clock.seconds)

    return method


def registered_by_similarity(start: Start, parts: Parts) -> Outcome:
    """RegGS: all that was lifted, brought to the context by one similarity."""
    clock = Clock(())
    with clock("generate"):
        reference = synthesized(start, parts)
    with clock("lift"):
        anchor = start.views[select_anchor(start.target, start.views).index]
        lifted = lift(parts.reconstructor, reference, anchor).gaussians
    with clock("register"):
        config = RegGSConfig(iterations=parts.iterations(RegGSConfig.iterations))
        found = register_by_similarity(
            lifted, start.context, reference, parts.renderer, parts.seed, config
        )
    added = replace(found.gaussians, generated=torch.ones_like(found.gaussians.generated))
    scene = merge([start.context, added])
    return Outcome(start.context, scene, added, start.hole_mask, clock.seconds)


def synthesized(start: Start, parts: Parts) -> View:
    """The image of Φ that `full` takes, as far as the target sees it.

    Φ draws it with the margin of `full`, which is cut off, so that not a pixel differs.
    """
    completer = parts.completer()
    return completer.reference(completer.begin(start.views, start.context), start.target)


BASELINES: dict[str, Method] = {
    "densify-100": optimized_with(OptimizationConfig(iterations=100)),
    "densify-800": optimized_with(OptimizationConfig(iterations=800)),
    "distill": optimized_with(OptimizationConfig(iterations=800, density_rounds=0)),
    "reggs": registered_by_similarity,
}
"""Methods that are not ours."""

_ABLATIONS = {"unconstrained" if name == "3-dof" else name: name for name in ABLATIONS}
# By the name of the method, that of its settings. Three degrees of freedom are no ablation but
# what the paper compares the ray constraint with.

SETTINGS: dict[str, str] = {
    "full": "default",
    "paper": "paper",
    **_ABLATIONS,
    **{f"paper/{title}": f"paper/{name}" for title, name in _ABLATIONS.items()},
}
"""Methods that are ours, and what `named_config` calls their settings."""

METHODS: dict[str, Method] = {
    "context": nothing_added,
    **{title: completed_with(name) for title, name in SETTINGS.items()},
    **BASELINES,
}
"""Every method by its name, in the order of the tables."""

GROUPS: dict[str, tuple[str, ...]] = {
    "ablations": tuple(_ABLATIONS),
    "baselines": tuple(BASELINES),
    "all": ("context", "full", "paper", *_ABLATIONS, *BASELINES),
}
"""Names that stand for several methods."""


def methods_named(names: Sequence[str]) -> tuple[str, ...]:
    """The methods that `names`, of methods or of groups, stand for, each once.

    Raises:
        InputError: where a name is of neither, or there is none.
    """
    found = [method for name in names for method in GROUPS.get(name, (name,))]
    chosen = tuple(dict.fromkeys(found))
    check_methods(chosen)
    return chosen


def check_methods(names: Sequence[str]) -> None:
    """Refuse names of no method, none at all, and the same one twice.

    Raises:
        InputError: where there is one.
    """
    names_of_all = [*GROUPS, *(name for name in METHODS if not name.startswith("paper/"))]
    known = ", ".join(names_of_all)
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
