"""Comparison of methods on the same target of the same scene, with the same image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gscompleter.apps.bench.manifest import BenchCase
from gscompleter.apps.bench.samples import Sample
from gscompleter.apps.bench.unfrozen import UnfrozenRenderer
from gscompleter.apps.bench.yardstick import Yardstick
from gscompleter.data.formats import open_photographs
from gscompleter.errors import InputError, quote_value
from gscompleter.evaluation.memory import measure_peak_memory
from gscompleter.evaluation.methods import BASELINES, METHODS, Method, Models, Prediction
from gscompleter.state import Completion
from gscompleter.types import Camera

OWN_STAGES = ("register", "integrate", "optimize")
"""Stages after generation and lifting, in which methods differ."""
OWN = "own"
"""Name of the sum of their seconds."""


def complete_with_autograd(state: Completion, target: Camera, models: Models) -> Prediction:
    """Complete as `full` does, with the same objectives and iterations but no frozen context."""
    return METHODS["full"](
        state, target, replace(models, renderer=UnfrozenRenderer(models.renderer))
    )


BENCH_METHODS: dict[str, Method] = {
    "full": METHODS["full"],
    "autograd": complete_with_autograd,
    **BASELINES,
}
"""Methods by name; the first one is ours, and times of others are multiples of its time."""


@dataclass(frozen=True)
class Start:
    """The state that all methods start from."""

    state: Completion
    target: Camera
    models: Models


def check_bench_methods(names: Sequence[str]) -> None:
    """Raise InputError for an unknown method."""
    for name in names:
        if name not in BENCH_METHODS:
            raise InputError(
                f"There is no method '{quote_value(name)}' to compare; choose one of "
                f"{', '.join(BENCH_METHODS)}.",
                "methods",
            )


def prepare_start(case: BenchCase, models: Models, device: str) -> Start:
    """Reconstruct the scene of a case once for all methods, with its first target."""
    photographs = open_photographs(case.scene, near=case.near, far=case.far)
    views = [view.to(device) for view in photographs.views(case.context, case.resolution)]
    target = photographs.camera(case.targets[0], case.resolution).to(device)
    return Start(models.make_completer().begin(views), target, models)


def measure_method(name: str, start: Start, yardstick: Yardstick) -> Sample:
    """Measure one run of a method, next to the yardstick."""

    def measure() -> Prediction:
        with measure_peak_memory(start.state.views[0].image.device) as peak:
            prediction = BENCH_METHODS[name](start.state, start.target, start.models)
        return replace(prediction, peak_bytes=peak.bytes)

    found, unit = yardstick.measure_beside(measure)
    added = len(found.scene) - len(start.state.scene)
    counts = {"context": len(start.state.scene), "added": added}
    return Sample(add_own_seconds(found.seconds), unit, found.peak_bytes, counts)


def add_own_seconds(seconds: Mapping[str, float]) -> dict[str, float]:
    """Add the sum of the stages in which methods differ."""
    own = sum(spent for stage, spent in seconds.items() if stage in OWN_STAGES)
    return {**seconds, OWN: own}
