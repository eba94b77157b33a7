"""Engines, which run jobs: local processes, Ray, or SLURM jobs through submitit.

An engine takes jobs one by one and yields outcomes in the order in which jobs end. A killed worker
costs its job one attempt and affects no other job.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal, Protocol, runtime_checkable

from gscompleter.jobs.jobs import Job, Outcome, Perform

EngineName = Literal["local", "ray", "submitit"]


@runtime_checkable
class Engine(Protocol):
    """Runs jobs on workers."""

    def __call__(self, perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Run `jobs` and yield their outcomes; closing the iterator stops the workers."""
        ...
