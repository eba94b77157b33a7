"""Methods to compare, by name. All of them begin with the same scene, and all that need a
synthesized image take the one that `full` takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from gscompleter.baselines.optimization import OptimizationConfig, optimize
from gscompleter.baselines.reggs import RegGSConfig, register_by_similarity
from gscompleter.completer import Clock, GSCompleter
from gscompleter.config import ABLATIONS, named_config
from gscompleter.errors import InputError, quoted
from gscompleter.generators import Generator
from gscompleter.reconstructors import Reconstructor
from gscompleter.render import Renderer
from gscompleter.stages.anchor import lift, select_anchor
from gscompleter.types import Camera, Completion, Gaussians, InitialContext, merge


@dataclass(frozen=True)
class Models:
    """The models that every method shares."""

    reconstructor: Reconstructor
    generator: Generator
    renderer: Renderer
    seed: int = 0
    """Of everything random."""
    baseline_iterations: int | None = None
    """Most iterations of the baselines; their own numbers if None."""

    def completer(self, config: str = "default") -> GSCompleter:
        """Our method with the settings called `config`."""
        return GSCompleter(
            self.reconstructor, self.generator, self.renderer, named_config(config), self.seed
        )

    def iterations(self, wanted: int) -> int:
        """`wanted`, or the most that is allowed."""
        return wanted if self.baseline_iterations is None else min(wanted, self.baseline_iterations)


@dataclass(frozen=True)
class Prediction:
    """What a method, ours or another, makes of a scene for one target."""

    scene: Gaussians
    """The scene afterwards."""
    added: Gaussians | None
    """What stands in `scene` beside the scene before; None where that itself was changed."""
    seconds: Mapping[str, float]
    """Wall time by stage, without the reconstruction of the context, and `total`."""
    anchor: int | None = None
    """Which view made the stereo pair with the target; None where nothing was lifted."""
    anchor_fallback: bool = False
    """True where every view was turned too far and the least-turned one was taken."""
    notes: tuple[str, ...] = ()
    """Fallbacks that were taken, a sentence each."""
    peak_bytes: int | None = None
    """The most memory that was held meanwhile; None where the system does not tell."""
    registered: Gaussians | None = None
    """All that was lifted, as it was registered, before any of it was filtered; None for a method
    that lifts nothing."""


Method = Callable[[Completion, Camera, Models], Prediction]
"""Takes the scene as it stands, with the photographs that are known, and the target."""


def nothing_added(state: Completion, target: Camera, models: Models) -> Prediction:
    """The scene alone."""
    return Prediction(state.scene, state.scene[:0], {"total": 0.0})


def completed_with(config: str) -> Method:
    """Our method with the settings called `config`."""

    def method(state: Completion, target: Camera, models: Models) -> Prediction:
        completer = replace(models.completer(config), keep_registered=True)
        context = InitialContext(state.scene, state.views)
        done = completer.advance(completer.begin_with(context), target)
        (made,) = done.targets
        told = (made.anchor, made.anchor_fallback, made.notes)
        return Prediction(done.scene, made.added, done.seconds, *told, registered=made.registered)

    return method


def optimized_with(config: OptimizationConfig) -> Method:
    """3DGS fitted to the photographs and the synthesized image, from the scene on."""

    def method(state: Completion, target: Camera, models: Models) -> Prediction:
        clock = Clock(())
        with clock("generate"):
            views = [*state.views, models.completer().reference(state, target)]
        budget = replace(config, iterations=models.iterations(config.iterations))
        with clock("optimize"):
            fitted = optimize(state.scene, views, models.renderer, models.seed, budget)
        return Prediction(fitted.gaussians, None, clock.seconds)

    return method


def registered_by_similarity(state: Completion, target: Camera, models: Models) -> Prediction:
    """RegGS: all that was lifted, brought to the scene by one similarity."""
    clock = Clock(())
    with clock("generate"):
        reference = models.completer().reference(state, target)
    with clock("lift"):
        anchor = select_anchor(reference.camera, state.views)
        lifted = lift(models.reconstructor, reference, state.views[anchor.index]).gaussians
    with clock("register"):
        config = RegGSConfig(iterations=models.iterations(RegGSConfig.iterations))
        added = register_by_similarity(
            lifted, state.scene, reference, models.renderer, models.seed, config
        ).gaussians
    scene = merge([state.scene, added])
    return Prediction(scene, added, clock.seconds, anchor.index, anchor.fallback, registered=added)


def numbered(prediction: Prediction, number: int, before: Gaussians) -> Prediction:
    """`prediction` with what it added to the scene `before` marked as made for target `number`."""
    if prediction.added is None:
        return prediction
    generated = torch.full_like(prediction.added.generated, number)
    added = replace(prediction.added, generated=generated)
    return replace(prediction, added=added, scene=merge([before, added]))


BASELINES: dict[str, Method] = {
    "densify-100": optimized_with(OptimizationConfig(iterations=100)),
    "densify-800": optimized_with(OptimizationConfig(iterations=800)),
    "distill": optimized_with(OptimizationConfig(iterations=800, density_rounds=0)),
    "reggs": registered_by_similarity,
}
"""Methods that are not ours."""

SCENE_CHANGING = ("densify-100", "densify-800", "distill")
"""Methods that change the scene that is there, so that their steps cannot be compared."""

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
        InputError: as `check_methods`.
    """
    found = [method for name in names for method in GROUPS.get(name, (name,))]
    chosen = tuple(dict.fromkeys(found))
    check_methods(chosen)
    return chosen


def check_methods(names: Sequence[str], steps: int = 1) -> None:
    """Raise an InputError for names of no method, none, one twice, and what cannot do `steps`."""
    known = ", ".join([*GROUPS, *(name for name in METHODS if not name.startswith("paper/"))])
    if not names:
        raise InputError(f"No method was named; choose one or more of {known}.")
    for name in names:
        if name not in METHODS:
            raise InputError(
                f"There is no method '{quoted(name)}'; choose of {known} (paper/no-sa for an "
                "ablation of the paper's settings)."
            )
        if steps > 1 and name in SCENE_CHANGING:
            raise InputError(
                f"The method {name!r} changes the scene that is there, and in a sequence each step "
                "has to add to it; choose of context, full, paper, an ablation of these, and reggs."
            )
    if len(set(names)) < len(names):
        raise InputError(f"A method is named twice ({' '.join(names)}); name each once.")
