"""Simulated time of a large batch: measured jobs, replayed through the scheduler.

    python benchmarks/simulate_batch.py OUT --jobs 10000 --workers 16 --lost-per-hour 0.05

Jobs are sampled from the rows that `gscompleter batch` wrote to OUT; with --jobs 0 they are
replayed as they are, to compare the simulation with the measured time.
"""

from __future__ import annotations

import argparse
import heapq
import json
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Fleet:
    workers: int
    start_seconds: float
    """Time until the first job of a worker: process, imports, compiled kernels."""
    lost_per_hour: float
    """Number of kills per worker and hour."""
    retries: int = 2


@dataclass(frozen=True)
class Replay:
    hours: float
    busy: float
    """Share of the workers' time spent on successful attempts."""
    repeated: int
    """Number of lost attempts."""
    given_up: int


def replay(seconds: Sequence[float], fleet: Fleet, seed: int = 0) -> Replay:
    """Simulate the workers of `fleet` on jobs of the given durations."""
    chance = random.Random(seed)
    free = [fleet.start_seconds] * fleet.workers
    waiting = [(job, 0) for job in range(len(seconds))][::-1]
    useful, repeated, given_up = 0.0, 0, 0
    while waiting:
        job, lost = waiting.pop()
        now = heapq.heappop(free)
        alive = chance.expovariate(fleet.lost_per_hour / 3600) if fleet.lost_per_hour else 1e99
        if alive >= seconds[job]:
            useful += seconds[job]
            heapq.heappush(free, now + seconds[job])
            continue
        repeated += 1
        heapq.heappush(free, now + alive + fleet.start_seconds)
        if lost < fleet.retries:
            waiting.insert(0, (job, lost + 1))
        else:
            given_up += 1
    end = max(free)
    return Replay(end / 3600, useful / (end * fleet.workers), repeated, given_up)


def read_done_rows(out: Path) -> list[dict]:
    rows = [json.loads(path.read_text()) for path in sorted((out / "rows").glob("*.json"))]
    return [row for row in rows if row["state"] == "done"]


def compute_measured_hours(out: Path, rows: Sequence[dict]) -> float:
    """Compute the hours from the start of the first job to the end of the last."""
    ends = [(out / "rows" / f"{row['job']}.json").stat().st_mtime for row in rows]
    return (max(ends) - min(e - r["seconds"] for e, r in zip(ends, rows, strict=True))) / 3600


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--jobs", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--start-seconds", type=float, default=10.0)
    parser.add_argument("--lost-per-hour", type=float, default=0.0)
    parser.add_argument("--longer", type=float, default=1.0, help="jobs take so many times as long")
    given = parser.parse_args()
    rows = read_done_rows(given.out)
    seconds = [given.longer * row["seconds"] for row in rows]
    if given.jobs:
        seconds = random.Random(0).choices(seconds, k=given.jobs)
    found = replay(seconds, Fleet(given.workers, given.start_seconds, given.lost_per_hour))
    print(f"{len(seconds):,} jobs, {given.workers:,} workers: {found.hours:.3f} h, {found}")
    if not given.jobs:
        print(f"measured: {compute_measured_hours(given.out, rows):.3f} h")


if __name__ == "__main__":
    main()
