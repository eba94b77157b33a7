"""Workers that run jobs until each has a row.

A worker runs its share of the jobs in order. If it is killed, it was at the first job without a
row: the loss of that job is counted, and the rest of the share is run again.
"""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

from gscompleter.errors import InputError
from gscompleter.jobs.jobs import Job

POLL_SECONDS = 0.1
"""Interval between checks of the workers and of the rows."""
SLURM_VARIABLES = ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_COUNT")
"""SLURM variables: number of this task of an array, of the first task, and of tasks."""

Perform = Callable[[Job], None]
"""Runs a job in any process and writes its row, unless it has one."""


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
    """Number of shares that run simultaneously."""
    start: Callable[[Share], Any]
    """Starts a share; returns its future, with `done()`, `exception()` and `result()`."""
    num_shares: int | None = None
    """Number of shares to divide the jobs into; None makes one of each job."""


Engine = Callable[[], AbstractContextManager[Pool]]
"""Opens a pool, whose workers are stopped at the end of the block."""


def run_jobs(
    jobs: Sequence[Job],
    perform: Perform,
    has_row: Callable[[Job], bool],
    engine: Engine | None = None,
    retries: int = 0,
) -> Iterator[Job]:
    """Run jobs until each has a row, and yield them in the order in which they end.

    Args:
        jobs: Jobs without a row.
        perform: Runs one of them; the row of a job lost more than `retries` times is a failure.
        has_row: Returns True if a job has its row.
        engine: Starts the workers; None runs the jobs in this process.
        retries: Number of times that a job may cost its worker.
    """
    if engine is None:
        for job in jobs:
            perform(job)
            yield job
        return
    running: dict[Any, list[Job]] = {}
    with engine() as pool:
        count = min(pool.num_shares or len(jobs), len(jobs))
        waiting = deque(list(jobs[i::count]) for i in range(count))
        while waiting or running:
            while waiting and len(running) < pool.size:
                share = waiting.popleft()
                running[pool.start(Share(perform, tuple(share)))] = share
            time.sleep(POLL_SECONDS)
            ended = [future for future in running if future.done()]
            for share in running.values():
                while share and has_row(share[0]):
                    yield share.pop(0)
            for future in ended:
                share = running.pop(future)
                if rest := collect_rest(future, share, retries):
                    waiting.append(rest)
                else:
                    yield from share


def collect_rest(future: Any, share: list[Job], retries: int) -> list[Job]:
    """Return what a killed worker left of its share, with the loss of the first job counted.

    It raises the error of a worker, which ends the run, and the loss of one that only had to list
    a job as failed.
    """
    killed = future.exception()
    if killed is None and (error := future.result()) is not None:
        raise error
    if killed is None or not share:
        return []
    first = replace(share[0], lost=share[0].lost + 1)
    if first.lost > retries + 1:
        raise killed
    return [first, *share[1:]]


def parse_shard(text: str | None, environment: Mapping[str, str]) -> tuple[int, int]:
    """Parse `i/n` (the jobs i, i + n, …), or `auto` in a SLURM array; None means all jobs.

    The numbers of the array have to be consecutive.
    """
    if text is None:
        return 0, 1
    if text == "auto":
        numbers = [environment.get(name, "") for name in SLURM_VARIABLES]
        if not all(number.isdecimal() for number in numbers):
            raise InputError(
                f"{SLURM_VARIABLES[0]} and {SLURM_VARIABLES[2]} are not set, so this is no SLURM "
                "array; give the shard as i/n.",
                "shard",
            )
        task, first, count = map(int, numbers)
        return check_shard((task - first, count))
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    number, count = map(int, match.groups()) if match else (-1, 0)
    return check_shard((number, count))


def check_shard(shard: tuple[int, int]) -> tuple[int, int]:
    """Return the shard, or raise InputError if it is impossible."""
    number, count = shard
    if not 0 <= number < count:
        raise InputError(
            "There is no such shard; give i/n: of four shards the first is 0/4, the last 3/4.",
            "shard",
        )
    return shard
