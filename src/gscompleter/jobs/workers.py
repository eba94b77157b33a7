"""Workers that share jobs until each has a row, from this or another process.

A worker runs its own share of the jobs first, and then those of the others that nobody claims. A
lost worker is started again; the claim of its job has counted the attempt.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from gscompleter.errors import InputError, quote_value
from gscompleter.jobs.jobs import Job
from gscompleter.jobs.places import Place

POLL_SECONDS = 0.2
"""Interval between checks of the workers and of the rows."""
ELSEWHERE_SECONDS = 1.0
"""Interval between checks of jobs that other commands run."""
LOSSES = (
    *("WorkerLostError", "WorkerCrashedError", "NodeDiedError", "OutOfMemoryError"),
    *("TaskCancelledError", "ObjectLostError", "UncompletedJobError", "FailedJobError"),
)
"""Names of the errors of local, Ray and SLURM workers that were killed."""

SLURM_VARIABLES = ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_COUNT")
"""SLURM variables: number of this task of an array, of the first task, and of tasks."""

Perform = Callable[[Job], None]
"""Runs a job in any process and writes its row, unless it has one or is claimed elsewhere."""


@dataclass(frozen=True)
class Share:
    """The jobs of one worker, in its order."""

    perform: Perform
    jobs: Sequence[Job]

    def __call__(self) -> Exception | None:
        """Run the jobs; return the error that ends the whole run, such as a full disk."""
        try:
            for job in self.jobs:
                self.perform(job)
        except Exception as error:  # engines do not all hand over what is raised
            return error
        return None


@dataclass(frozen=True)
class Pool:
    """The workers of an engine."""

    size: int
    start: Callable[[Sequence[Share]], Sequence[Any]]
    """Starts a worker per share; returns their futures, with `done()`, `exception()`, `result()`"""


@runtime_checkable
class Engine(Protocol):
    """Starts workers somewhere."""

    def open(self) -> AbstractContextManager[Pool]:
        """Open a pool; its workers are stopped at the end of the block."""
        ...


def run_jobs(
    place: Place,
    jobs: Sequence[Job],
    perform: Perform,
    list_done: Callable[[], set[str]],
    engine: Engine | None = None,
    retries: int = 0,
) -> Iterator[Job]:
    """Run jobs until each has a row, and yield them in the order in which they end.

    Args:
        place: The folder of the claims.
        jobs: Jobs without a row.
        perform: Runs one of them.
        list_done: Lists the names of jobs that have a row.
        engine: Starts the workers; None runs the jobs in this process.
        retries: Number of times that a job may cost its worker.
    """
    left = {job.name: job for job in jobs}

    def pop_done() -> Iterator[Job]:
        for name in [name for name in list_done() if name in left]:
            yield left.pop(name)

    while left:
        waiting = list(left.values())
        for _ in (
            map(perform, waiting)
            if engine is None
            else run_on_workers(engine, place, waiting, perform, retries)
        ):
            yield from pop_done()
        yield from pop_done()
        while left and all(place.is_held(job.claim) for job in left.values()):
            time.sleep(ELSEWHERE_SECONDS)
            yield from pop_done()


def run_on_workers(
    engine: Engine, place: Place, jobs: Sequence[Job], perform: Perform, retries: int
) -> Iterator[None]:
    """Run jobs on the workers of an engine, and yield regularly until all workers have ended."""
    losses = 0
    with engine.open() as pool:
        shares = [Share(perform, found) for found in divide_jobs(jobs, pool.size, place)]
        running = dict(zip(pool.start(shares), shares, strict=True))
        while running:
            time.sleep(POLL_SECONDS)
            for future in [future for future in running if future.done()]:
                share, error = running.pop(future), future.exception()
                if error is None:
                    error = future.result()
                elif type(error).__name__ in LOSSES and losses < (retries + 1) * len(jobs):
                    losses, error = losses + 1, None
                    running[pool.start([share])[0]] = share
                if error is not None:
                    raise error
            yield


def divide_jobs(jobs: Sequence[Job], count: int, place: Place) -> list[list[Job]]:
    """Divide jobs among workers; with locks, each then also has those of the others."""
    shares = [list(jobs[i::count]) for i in range(min(count, len(jobs)))]
    if not place.has_locks:
        return shares
    return [
        [job for share in (*shares[first:], *shares[:first]) for job in share]
        for first in range(len(shares))
    ]


def parse_shard(text: str | None, environment: Mapping[str, str]) -> tuple[int, int]:
    """Parse `i/n` (the jobs i, i + n, …), or `auto` in a SLURM array; None means all jobs."""
    if text is None:
        return 0, 1
    if text == "auto":
        return parse_slurm_shard(environment)
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if match is None:
        raise InputError(
            f"The shard is '{quote_value(text)}'; give it as i/n, as in 0/4 for the first of four, "
            "or auto in an array of SLURM.",
            "shard",
        )
    return check_shard((int(match[1]), int(match[2])))


def parse_slurm_shard(environment: Mapping[str, str]) -> tuple[int, int]:
    """Return the shard of a SLURM task; the numbers of the array have to be consecutive."""
    numbers = [environment.get(name, "") for name in SLURM_VARIABLES]
    if not all(number.isdecimal() for number in numbers):
        raise InputError(
            f"{SLURM_VARIABLES[0]} and {SLURM_VARIABLES[2]} are not set, so this is no SLURM "
            "array; give the shard as i/n.",
            "shard",
        )
    task, first, count = map(int, numbers)
    return check_shard((task - first, count))


def check_shard(shard: tuple[int, int]) -> tuple[int, int]:
    """Return the shard, or raise InputError if it is impossible."""
    number, count = shard
    if not 0 <= number < count:
        raise InputError(
            f"There is no shard {number}/{count}; of n shards the first is 0/n, the last (n-1)/n."
        )
    return shard
