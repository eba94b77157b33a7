"""Who does the jobs: processes of this machine, Ray, or jobs of SLURM by submitit.

An engine is given jobs one by one and says what became of each, in the order in which they end. A
worker that is killed costs its job an attempt, and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal, Protocol, runtime_checkable

from gscompleter.batch.jobs import Job, Outcome, Perform

EngineName = Literal["local", "ray", "submitit"]


@runtime_checkable
class Engine(Protocol):
    """Lets workers do jobs."""

    def __call__(self, perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """What became of `jobs`, of which one is taken whenever a worker is free.

        Closing the iterator stops the workers.

        Raises:
            OutputError: where results cannot be written.
        """
        ...
