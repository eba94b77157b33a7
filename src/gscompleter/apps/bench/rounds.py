"""Measurements in turns, so that a busy machine slows all of them alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gscompleter.apps.bench.samples import Sample, SampleSet
from gscompleter.progress import show_progress, track


@dataclass(frozen=True)
class BenchTask:
    """A measurement that is repeated."""

    name: str
    measure: Callable[[], Sample]
    stage: str
    """Stage whose seconds the progress lines show."""
    repeats: int


def measure_in_rounds(
    tasks: Sequence[BenchTask], report_line: Callable[[str], None]
) -> dict[str, SampleSet]:
    """Run each task once per round until it has its repeats; `tell` receives progress lines."""
    samples: dict[str, list[Sample]] = {task.name: [] for task in tasks}
    turns = [
        task
        for number in range(max((task.repeats for task in tasks), default=0))
        for task in tasks
        if number < task.repeats
    ]
    for number, task in enumerate(track(turns, "measuring"), start=1):
        with show_progress(None):  # no progress lines inside a measurement
            sample = task.measure()
        samples[task.name].append(sample)
        seconds, ratio = sample.seconds[task.stage], sample.ratios[task.stage]
        report_line(f"{number}/{len(turns)} {task.name}: {seconds:.2f} s, {ratio:.1f} yardsticks")
    return {name: SampleSet(name, tuple(found)) for name, found in samples.items() if found}
