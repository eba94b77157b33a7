"""What a job costs: seconds and bytes, stage by stage."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from gscompleter.progress import stages_heard_by

COUNTERS = Path("/proc/self/io")
"""Where Linux counts what this process read and wrote, whether or not it reached a disk."""


@dataclass
class Cost:
    """What a stage took."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Of all threads: what it takes of a machine, however busy that is."""
    read_bytes: int = 0
    written_bytes: int = 0


@dataclass
class Meter:
    """Gives what is spent to the stage that began last."""

    stages: dict[str, Cost] = field(default_factory=dict)
    name: str = "open"
    begun: Cost = field(default_factory=Cost)
    """The clock and the counters when it began."""

    def begin(self, name: str) -> None:
        """From now on, what is spent is the cost of `name`."""
        now, cost = spent(), self.stages.setdefault(self.name, Cost())
        cost.seconds += now.seconds - self.begun.seconds
        cost.cpu_seconds += now.cpu_seconds - self.begun.cpu_seconds
        cost.read_bytes += now.read_bytes - self.begun.read_bytes
        cost.written_bytes += now.written_bytes - self.begun.written_bytes
        self.name, self.begun = name, now


@contextmanager
def metered() -> Iterator[Meter]:
    """Measure what is done inside, by the stages that it tells of."""
    meter = Meter(begun=spent())
    with stages_heard_by(meter.begin):
        yield meter
    meter.begin("")


def spent() -> Cost:
    """The clocks, and the bytes that this process has read and written; 0 where nobody counts."""
    counters = COUNTERS.read_text() if COUNTERS.is_file() else ""
    found = dict(re.findall(r"^(\w+): ([0-9]+)$", counters, re.M))
    read, written = int(found.get("rchar", 0)), int(found.get("wchar", 0))
    return Cost(time.monotonic(), time.process_time(), read, written)
