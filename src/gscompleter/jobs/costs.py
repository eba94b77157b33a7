"""Costs of a job by stage: seconds and bytes."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from gscompleter.progress import notify_of_stages

COUNTERS = Path("/proc/self/io")
"""File in which Linux counts the bytes that this process reads and writes, cached or not."""


@dataclass
class Cost:
    """Cost of a stage."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Sum over all threads, which does not depend on how busy the machine is."""
    read_bytes: int = 0
    written_bytes: int = 0


@dataclass
class Meter:
    """Assigns costs to the stage that started last."""

    stages: dict[str, Cost] = field(default_factory=dict)
    name: str = "open"
    start: Cost = field(default_factory=Cost)
    """Clock and counters at its start."""

    def begin(self, name: str) -> None:
        """End the current stage and start the stage `name`."""
        now, cost = read_counters(), self.stages.setdefault(self.name, Cost())
        cost.seconds += now.seconds - self.start.seconds
        cost.cpu_seconds += now.cpu_seconds - self.start.cpu_seconds
        cost.read_bytes += now.read_bytes - self.start.read_bytes
        cost.written_bytes += now.written_bytes - self.start.written_bytes
        self.name, self.start = name, now


@contextmanager
def measure_costs() -> Iterator[Meter]:
    """Measure the body by stage."""
    meter = Meter(start=read_counters())
    with notify_of_stages(meter.begin):
        yield meter
    meter.begin("")


def read_counters() -> Cost:
    """Read the clocks and the byte counters of this process; 0 if the system has no counters."""
    counters = COUNTERS.read_text() if COUNTERS.is_file() else ""
    found = dict(re.findall(r"^(\w+): ([0-9]+)$", counters, re.M))
    read, written = int(found.get("rchar", 0)), int(found.get("wchar", 0))
    return Cost(time.monotonic(), time.process_time(), read, written)
