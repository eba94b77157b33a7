"""SLURM jobs, or local processes without SLURM, sent by submitit; each has a share."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError, quote_value
from gscompleter.jobs.jobs import Job, Outcome, Perform

POLL_SECONDS = 2.0
"""Interval between checks of the SLURM jobs."""


@dataclass(frozen=True)
class SubmititEngine:
    """Workers that are SLURM jobs."""

    workers: int
    threads: int
    gpus: float
    folder: Path
    """Folder for submitit's files and the output of the jobs."""
    parameters: Mapping[str, str]
    """Further SLURM parameters such as `partition` and `time`."""

    def __call__(self, perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Run jobs as `Engine` does."""
        listed = list(jobs)
        shares = [share for i in range(self.workers) if (share := listed[i :: self.workers])]
        executor = self._make_executor()
        with executor.batch():
            sent = [executor.submit(Share(perform, self.threads), share) for share in shares]
        waiting = dict(zip(sent, shares, strict=True))
        try:
            while waiting:
                for job in [job for job in waiting if job.done()]:
                    yield from collect_outcomes(job, waiting.pop(job))
                if waiting:
                    time.sleep(POLL_SECONDS)
        finally:
            for job in waiting:
                with contextlib.suppress(Exception):  # it may just have ended
                    job.cancel()

    def _make_executor(self) -> Any:
        try:
            import submitit
        except ImportError as error:
            raise InputError(
                "The engine submitit needs a package; install it with `pip install submitit`."
            ) from error
        executor = submitit.AutoExecutor(folder=str(self.folder))
        here = executor.cluster == "local"
        further = {} if here else {f"slurm_{k}": v for k, v in self.parameters.items()}
        try:
            executor.update_parameters(
                cpus_per_task=self.threads,
                gpus_per_node=int(self.gpus),
                name="gscompleter",
                **({"timeout_min": 24 * 60} if here else {}),
                **further,
            )
        except (ValueError, NameError, TypeError) as error:
            raise InputError(
                f"A parameter of SLURM is invalid: {quote_value(str(error))}; correct it."
            ) from error
        return executor


@dataclass(frozen=True)
class Share:
    """Runs a share of a batch in a SLURM job."""

    perform: Perform
    threads: int

    def __call__(self, share: Sequence[Job]) -> list[Outcome]:
        """Run the jobs of a share one after the other."""
        from gscompleter.cpu_threads import limit_threads
        from gscompleter.io.interrupts import handle_stop_signals

        limit_threads(self.threads)
        handle_stop_signals()
        return [self.perform(job) for job in share]

    def checkpoint(self, share: Sequence[Job]) -> Any:
        """Resubmit the share if SLURM preempts the job; jobs with a row are skipped."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, share)


def collect_outcomes(sent: Any, share: Sequence[Job]) -> Iterator[Outcome]:
    """Yield the outcomes of a share; all of them are lost if its SLURM job was killed."""
    error = sent.exception()
    if error is None:
        yield from sent.result()
    elif type(error).__name__ in ("UncompletedJobError", "FailedJobError"):
        yield from (Outcome(job, "lost") for job in share)
    else:
        raise error
