"""Jobs of a batch until each has a row, whoever does it."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from gscompleter.batch.engines import Engine
from gscompleter.batch.jobs import (
    CLAIMS,
    Attempts,
    Job,
    Outcome,
    Perform,
    finished_row,
    row_of,
    write_row,
)
from gscompleter.batch.places import Place

POLL_SECONDS = 1.0
"""How often it is looked whether others have done what they began."""


@runtime_checkable
class Rows(Protocol):
    """What becomes of jobs, as it is written down."""

    def ended(self, job: Job) -> Outcome | None:
        """What became of a job; None where it is still to be done."""
        ...

    def give_up(self, job: Job, reason: str) -> Outcome:
        """Write down that a job came to nothing."""
        ...


@dataclass(frozen=True)
class BatchRows:
    """A row for each job of a batch."""

    place: Place

    def ended(self, job: Job) -> Outcome | None:
        row = finished_row(self.place, job)
        return None if row is None else Outcome(job, row["state"], row["reason"])

    def give_up(self, job: Job, reason: str) -> Outcome:
        write_row(self.place, job.name, row_of(job, Attempts(None, 0, reason)))
        return Outcome(job, "failed", reason)


def in_this_process(perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
    """The engine that needs no other process: one job after the other."""
    return map(perform, jobs)


@dataclass
class Rounds:
    """Hands out jobs, takes back what was lost, and waits for what others do."""

    place: Place
    rows: Rows
    jobs: Sequence[Job]
    retries: int
    """How often a job is sent again whose worker was lost."""
    waiting: deque[Job] = field(default_factory=deque)
    elsewhere: list[Job] = field(default_factory=list)
    lost: Counter[str] = field(default_factory=Counter)

    def outcomes(self, engine: Engine, perform: Perform) -> Iterator[Outcome]:
        """What became of each of the jobs, in the order in which they end."""
        self.waiting.extend(self.jobs)
        while self.waiting or self.elsewhere:
            for outcome in engine(perform, self.offered()):
                yield from self.heard(outcome)
            yield from self.done_by_others()
            if self.elsewhere and not self.waiting:
                time.sleep(POLL_SECONDS)

    def offered(self) -> Iterator[Job]:
        """Jobs that wait, each as it is asked for; what is lost meanwhile is offered again."""
        while self.waiting:
            yield self.waiting.popleft()

    def heard(self, outcome: Outcome) -> Iterator[Outcome]:
        """`outcome`, where it is the last word on its job."""
        job = outcome.job
        if outcome.state == "elsewhere":
            self.elsewhere.append(job)
        elif outcome.state == "lost" and self.lost[job.name] < self.retries:
            self.lost[job.name] += 1
            self.waiting.append(job)
        elif outcome.state == "lost":
            yield self.given_up(job)
        else:
            yield outcome

    def given_up(self, job: Job) -> Outcome:
        """What is said of a job whose workers were lost as often as may be."""
        ended = self.rows.ended(job)
        lost = self.lost[job.name] + 1
        reason = f"its worker was lost {lost} times, perhaps for want of memory"
        return self.rows.give_up(job, reason) if ended is None else ended

    def done_by_others(self) -> Iterator[Outcome]:
        """What others have done of what they claimed; what they let go waits for us again."""
        held = []
        for job in self.elsewhere:
            is_held = self.place.is_held(f"{CLAIMS}/{job.name}")
            ended = self.rows.ended(job)
            if ended is not None:
                yield ended
            elif is_held:
                held.append(job)
            else:
                self.waiting.append(job)
        self.elsewhere = held
