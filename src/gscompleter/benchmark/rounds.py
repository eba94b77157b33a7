"""Measurements in turns, so that a busy machine slows all of them alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gscompleter.benchmark.samples import Measured, Sample
from gscompleter.progress import shown_on, track


@dataclass(frozen=True)
class Task:
    """A measurement that is repeated."""

    name: str
    measure: Callable[[], Sample]
    stage: str
    """Stage whose seconds the progress lines show."""
    repeats: int


def in_rounds(tasks: Sequence[Task], tell: Callable[[str], None]) -> dict[str, Measured]:
    """Run each task once per round until it has its repeats; `tell` receives progress lines."""
    samples: dict[str, list[Sample]] = {task.name: [] for task in tasks}
    turns = [
        task
        for number in range(max((task.repeats for task in tasks), default=0))
        for task in tasks
        if number < task.repeats
    ]
    for number, task in enumerate(track(turns, "measuring"), start=1):
        with shown_on(None):  # no progress lines inside a measurement
            sample = task.measure()
        samples[task.name].append(sample)
        seconds, ratio = sample.seconds[task.stage], sample.ratios[task.stage]
        tell(f"{number}/{len(turns)} {task.name}: {seconds:.2f} s, {ratio:.1f} yardsticks")
    return {name: Measured(name, tuple(found)) for name, found in samples.items() if found}
