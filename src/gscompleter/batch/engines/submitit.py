"""Jobs of SLURM, sent by submitit: each does a share of the batch, one job after the other.

Where there is no SLURM, submitit starts them as processes of this machine.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.batch.jobs import Job, Outcome, Perform
from gscompleter.errors import InputError, quoted

POLL_SECONDS = 2.0
"""How often SLURM's jobs are looked at."""


@dataclass(frozen=True)
class SubmititEngine:
    """Workers that are jobs of SLURM."""

    workers: int
    threads: int
    gpus: float
    folder: Path
    """Where submitit keeps what it sends, and what the jobs print."""
    parameters: Mapping[str, str]
    """What SLURM is told besides, as in `partition` and `time`."""

    def __call__(self, perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
        listed = list(jobs)
        shares = [share for i in range(self.workers) if (share := listed[i :: self.workers])]
        executor = self._executor()
        with executor.batch():
            sent = [executor.submit(Share(perform, self.threads), share) for share in shares]
        waiting = dict(zip(sent, shares, strict=True))
        try:
            while waiting:
                for job in [job for job in waiting if job.done()]:
                    yield from outcomes_of(job, waiting.pop(job))
                if waiting:
                    time.sleep(POLL_SECONDS)
        finally:
            for job in waiting:
                with contextlib.suppress(Exception):  # it may just have ended
                    job.cancel()

    def _executor(self) -> Any:
        try:
            import submitit
        except ImportError as error:
            raise InputError(
                "The engine submitit needs a package; install it with `pip install submitit`."
            ) from error
        executor = submitit.AutoExecutor(folder=str(self.folder))
        here = executor.cluster == "local"
        asked = {} if here else {f"slurm_{k}": v for k, v in self.parameters.items()}
        try:
            executor.update_parameters(
                cpus_per_task=self.threads,
                gpus_per_node=int(self.gpus),
                name="gscompleter",
                **({"timeout_min": 24 * 60} if here else {}),
                **asked,
            )
        except (ValueError, NameError, TypeError) as error:
            raise InputError(f"SLURM is told something wrong: {quoted(str(error))}.") from error
        return executor


@dataclass(frozen=True)
class Share:
    """Does a share of a batch in a job of SLURM."""

    perform: Perform
    threads: int

    def __call__(self, share: Sequence[Job]) -> list[Outcome]:
        from gscompleter.interrupts import treat_stops_alike
        from gscompleter.threads import bound_threads

        bound_threads(self.threads)
        treat_stops_alike()
        return [self.perform(job) for job in share]

    def checkpoint(self, share: Sequence[Job]) -> Any:
        """What SLURM is given once more where it takes the machine away: what has a row is left."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, share)


def outcomes_of(sent: Any, share: Sequence[Job]) -> Iterator[Outcome]:
    """What became of a share; where its job was killed, which of it had a row is not known.

    Raises whatever ended the work of the share.
    """
    error = sent.exception()
    if error is None:
        yield from sent.result()
    elif type(error).__name__ in ("UncompletedJobError", "FailedJobError"):
        yield from (Outcome(job, "lost") for job in share)
    else:
        raise error
