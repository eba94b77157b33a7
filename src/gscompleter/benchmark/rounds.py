"""Measuring in turns: what slows a shared machine for a while falls on everything alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gscompleter.benchmark.samples import Measured, Sample
from gscompleter.progress import shown_on, track


@dataclass(frozen=True)
class Task:
    """Something that is measured several times."""

    name: str
    measure: Callable[[], Sample]
    stage: str
    """What of its seconds is told while it goes on."""
    repeats: int


def in_rounds(tasks: Sequence[Task], tell: Callable[[str], None]) -> dict[str, Measured]:
    """Each task once in every round, until it had its repeats; by name, what was measured.

    Args:
        tasks: Of different names.
        tell: Is given a line after each measurement.
    """
    samples: dict[str, list[Sample]] = {task.name: [] for task in tasks}
    turns = [
        task
        for number in range(max((task.repeats for task in tasks), default=0))
        for task in tasks
        if number < task.repeats
    ]
    for number, task in enumerate(track(turns, "measuring"), start=1):
        with shown_on(None):  # what is measured shows nothing
            sample = task.measure()
        samples[task.name].append(sample)
        seconds, ratio = sample.seconds[task.stage], sample.ratios[task.stage]
        tell(f"{number}/{len(turns)} {task.name}: {seconds:.2f} s, {ratio:.1f} yardsticks")
    return {name: Measured(name, tuple(found)) for name, found in samples.items() if found}
