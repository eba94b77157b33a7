"""Rounds of jobs, until each has a row from this or another process."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from gscompleter.jobs.engines import Engine
from gscompleter.jobs.jobs import (
    CLAIMS,
    Attempts,
    Job,
    Outcome,
    Perform,
    make_job_row,
    read_finished_row,
    write_row,
)
from gscompleter.jobs.places import Place

POLL_SECONDS = 1.0
"""Interval between checks for rows of other processes."""


@runtime_checkable
class Rows(Protocol):
    """The rows of jobs, wherever they are stored."""

    def find_outcome(self, job: Job) -> Outcome | None:
        """Return the outcome of a job, or None if it has no row."""
        ...

    def give_up(self, job: Job, reason: str) -> Outcome:
        """Write a row for a job that cannot be completed."""
        ...


@dataclass(frozen=True)
class BatchRows:
    """The rows of the jobs of a batch."""

    place: Place

    def find_outcome(self, job: Job) -> Outcome | None:
        """Return the outcome of a job, or None if it has no row."""
        row = read_finished_row(self.place, job)
        return None if row is None else Outcome(job, row["state"], row["reason"])

    def give_up(self, job: Job, reason: str) -> Outcome:
        """Write a row for a job that cannot be completed."""
        write_row(self.place, job.name, make_job_row(job, Attempts(None, 0, reason)))
        return Outcome(job, "failed", reason)


def run_in_this_process(perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
    """Run jobs one after the other in this process: the simplest engine."""
    return map(perform, jobs)


@dataclass
class Rounds:
    """Distributes jobs, repeats lost ones, and waits for those of other processes."""

    place: Place
    rows: Rows
    jobs: Sequence[Job]
    retries: int
    """Number of retries of a job whose worker was lost."""
    waiting: deque[Job] = field(default_factory=deque)
    elsewhere: list[Job] = field(default_factory=list)
    lost: Counter[str] = field(default_factory=Counter)

    def run(self, engine: Engine, perform: Perform) -> Iterator[Outcome]:
        """Run all jobs and yield their outcomes in the order in which they end."""
        self.waiting.extend(self.jobs)
        while self.waiting or self.elsewhere:
            for outcome in engine(perform, self.take_waiting()):
                yield from self.handle_outcome(outcome)
            yield from self.collect_from_others()
            if self.elsewhere and not self.waiting:
                time.sleep(POLL_SECONDS)

    def take_waiting(self) -> Iterator[Job]:
        """Yield waiting jobs on demand, including those that are lost in the meantime."""
        while self.waiting:
            yield self.waiting.popleft()

    def handle_outcome(self, outcome: Outcome) -> Iterator[Outcome]:
        """Record an outcome, and yield it if it is final."""
        job = outcome.job
        if outcome.state == "elsewhere":
            self.elsewhere.append(job)
        elif outcome.state == "lost" and self.lost[job.name] < self.retries:
            self.lost[job.name] += 1
            self.waiting.append(job)
        elif outcome.state == "lost":
            yield self.give_up_lost(job)
        else:
            yield outcome

    def give_up_lost(self, job: Job) -> Outcome:
        """Return the outcome of a job that has been lost too often."""
        ended = self.rows.find_outcome(job)
        lost = self.lost[job.name] + 1
        reason = f"its worker was lost {lost} times, perhaps because memory ran out"
        return self.rows.give_up(job, reason) if ended is None else ended

    def collect_from_others(self) -> Iterator[Outcome]:
        """Yield outcomes of other processes; jobs that they released wait again."""
        held = []
        for job in self.elsewhere:
            is_held = self.place.is_held(f"{CLAIMS}/{job.name}")
            ended = self.rows.find_outcome(job)
            if ended is not None:
                yield ended
            elif is_held:
                held.append(job)
            else:
                self.waiting.append(job)
        self.elsewhere = held
