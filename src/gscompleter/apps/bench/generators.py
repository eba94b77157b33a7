"""Comparison of generators: each fills the holes of the same held-back photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median

from gscompleter.apps.bench.cases import BenchCase
from gscompleter.evaluation.methods import Models
from gscompleter.evaluation.metrics.scores import PartQuality, measure_part
from gscompleter.evaluation.tables import format_markdown
from gscompleter.generators import load_generator
from gscompleter.state import Completion
from gscompleter.system.errors import InputError
from gscompleter.system.progress import track
from gscompleter.types import View


@dataclass(frozen=True)
class Filling:
    """The first target of a case, completed with one generator."""

    seconds: float
    """Wall time of the generator alone."""
    hole: PartQuality


def compare_generators(
    names: Sequence[str], cases: Sequence[BenchCase], models: Models, device: str
) -> dict[str, list[Filling]]:
    """Complete the first target of each case with each generator, with their default settings.

    Raises:
        InputError: A generator cannot be loaded, for instance for lack of its weights, or no target
            has a hole.
    """
    loaded = {name: load_generator(name, models.seed, device=device) for name in names}
    found: dict[str, list[Filling]] = {name: [] for name in names}
    for case in track(cases, "filling"):
        (photograph,) = case.open().views(case.targets[:1], case.resolution)
        state = case.begin(models, device)
        for name, generator in loaded.items():
            completer = replace(models, generator=generator).make_completer()
            done = completer.advance(state, photograph.camera.to(device))
            found[name] += score_filling(done, photograph.to(device))
    if not any(found.values()):
        raise InputError("No case has a hole at its first target; name others.", "cases")
    return found


def score_filling(done: Completion, photograph: View) -> list[Filling]:
    """Score the last target in its hole; none if there was nothing to fill."""
    result = done.targets[-1]
    if result.reference is None:
        return []
    hole = measure_part(result.after.image, photograph, result.hole_mask)
    return [Filling(done.seconds["generate"], hole)]


def format_generators(found: dict[str, list[Filling]]) -> str:
    """Format the mean scores in holes and the median seconds, one row per generator."""
    columns = ["generator", "cases", "seconds", "PSNR (hole)", "HaarPSI (hole)"]
    rows = [
        [
            name,
            str(len(fillings)),
            f"{median(one.seconds for one in fillings):.2f}",
            format_mean([one.hole.psnr for one in fillings], 2),
            format_mean([one.hole.haarpsi for one in fillings], 3),
        ]
        for name, fillings in found.items()
    ]
    return format_markdown(columns, rows)


def format_mean(values: Sequence[float | None], digits: int) -> str:
    """Format the mean of the known values, or a dash without one."""
    known = [value for value in values if value is not None]
    return f"{fmean(known):.{digits}f}" if known else "–"
