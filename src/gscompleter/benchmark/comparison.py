"""Comparison of methods on the same target of the same scene, with the same image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gscompleter.benchmark.manifest import BenchCase
from gscompleter.benchmark.samples import Sample
from gscompleter.benchmark.unfrozen import Unfrozen
from gscompleter.benchmark.yardstick import Yardstick
from gscompleter.data.formats import open_photographs
from gscompleter.errors import InputError, quoted
from gscompleter.runs.memory import peak_memory
from gscompleter.runs.methods import BASELINES, METHODS, Method, Models, Prediction
from gscompleter.types import Camera, Completion

OWN_STAGES = ("register", "integrate", "optimize")
"""Stages after generation and lifting, in which methods differ."""
OWN = "own"
"""Name of the sum of their seconds."""


def with_plain_autograd(state: Completion, target: Camera, models: Models) -> Prediction:
    """Complete as `full` does, with the same objectives and iterations but no frozen context."""
    return METHODS["full"](state, target, replace(models, renderer=Unfrozen(models.renderer)))


COMPARED: dict[str, Method] = {
    "full": METHODS["full"],
    "autograd": with_plain_autograd,
    **BASELINES,
}
"""Methods by name; the first one is ours, and times of others are multiples of its time."""


@dataclass(frozen=True)
class Start:
    """The state that all methods start from."""

    state: Completion
    target: Camera
    models: Models


def check_compared(names: Sequence[str]) -> None:
    """Raise InputError for an unknown method."""
    for name in names:
        if name not in COMPARED:
            raise InputError(
                f"There is no method '{quoted(name)}' to compare; choose one of "
                f"{', '.join(COMPARED)}.",
                "methods",
            )


def start_of(case: BenchCase, models: Models, device: str) -> Start:
    """Reconstruct the scene of a case once for all methods, with its first target."""
    photographs = open_photographs(case.scene, near=case.near, far=case.far)
    views = [view.to(device) for view in photographs.views(case.context, case.resolution)]
    target = photographs.camera(case.targets[0], case.resolution).to(device)
    return Start(models.completer().begin(views), target, models)


def compared(name: str, start: Start, yardstick: Yardstick) -> Sample:
    """Measure one run of a method, next to the yardstick."""

    def measure() -> Prediction:
        with peak_memory(start.state.views[0].image.device) as peak:
            prediction = COMPARED[name](start.state, start.target, start.models)
        return replace(prediction, peak_bytes=peak.bytes)

    found, unit = yardstick.beside(measure)
    added = len(found.scene) - len(start.state.scene)
    counts = {"context": len(start.state.scene), "added": added}
    return Sample(with_own(found.seconds), unit, found.peak_bytes, counts)


def with_own(seconds: Mapping[str, float]) -> dict[str, float]:
    """Add the sum of the stages in which methods differ."""
    own = sum(spent for stage, spent in seconds.items() if stage in OWN_STAGES)
    return {**seconds, OWN: own}
