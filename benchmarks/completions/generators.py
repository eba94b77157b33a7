"""Comparison of generators: each fills the holes of the same held-back photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median

from completions.cases import BenchCase
from gscompleter.evaluation.methods import Models
from gscompleter.evaluation.metrics.scores import PartQuality, measure_part
from gscompleter.evaluation.tables import format_markdown
from gscompleter.generators import load_generator
from gscompleter.system.errors import InputError
from gscompleter.system.progress import track


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
    fillings: dict[str, list[Filling]] = {name: [] for name in names}
    for case in track(cases, "filling"):
        (photograph,) = case.open().views(case.targets[:1], case.resolution)
        # All generators continue the same context, so that only the filling differs.
        state = case.begin(models, device)
        for name, generator in loaded.items():
            completer = replace(models, generator=generator).make_completer()
            completion = completer.advance(state, photograph.camera.to(device))
            result = completion.targets[-1]
            # Without a synthesized image there was nothing to fill.
            if result.reference is not None:
                hole = measure_part(result.after.image, photograph.to(device), result.hole_mask)
                fillings[name].append(Filling(completion.seconds["generate"], hole))
    if not any(fillings.values()):
        raise InputError("No case has a hole at its first target; name others.", "cases")
    return fillings


def format_generators(fillings_by_name: dict[str, list[Filling]]) -> str:
    """Format the mean scores in holes and the median seconds, one row per generator."""
    columns = ["generator", "cases", "seconds", "PSNR (hole)", "HaarPSI (hole)"]
    rows = [
        [
            name,
            str(len(fillings)),
            f"{median(filling.seconds for filling in fillings):.2f}",
            format_mean([filling.hole.psnr for filling in fillings], 2),
            format_mean([filling.hole.haarpsi for filling in fillings], 3),
        ]
        for name, fillings in fillings_by_name.items()
    ]
    return format_markdown(columns, rows)


def format_mean(values: Sequence[float | None], digits: int) -> str:
    """Format the mean of the known values, or a dash without one."""
    known = [value for value in values if value is not None]
    return f"{fmean(known):.{digits}f}" if known else "–"
