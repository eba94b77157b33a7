"""Ray tasks, on an existing cluster or a local one."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from gscompleter.cpu_threads import limit_threads
from gscompleter.errors import InputError, quote_value
from gscompleter.jobs.jobs import Job, Outcome, Perform

IN_FLIGHT = 2
"""Tasks that wait or run, per task that the cluster can run at once."""
STORE_BYTES = 200 * 10**6
"""Memory for return values in a local cluster; they are small, as results are files."""
STOP_SECONDS = 20.0
"""Time that stopped tasks have to release their claims."""


@dataclass(frozen=True)
class RayEngine:
    """Workers that are Ray tasks."""

    workers: int | None
    """Number of simultaneous tasks; None uses all of the cluster."""
    threads: int
    gpus: float = 0.0
    """GPUs per task, possibly a fraction."""
    address: str | None = None
    """Address of a cluster; None starts one on this machine."""

    def __call__(self, perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Run jobs as `Engine` does."""
        with self._connect() as ray:
            # `Rounds` repeats lost tasks, because it counts the attempts of a job.
            task = ray.remote(run_remote_job).options(
                num_cpus=self.threads, num_gpus=self.gpus, max_retries=0
            )
            waiting = iter(jobs)
            running: dict[Any, Job] = {}
            try:
                for _, job in zip(range(self._count_in_flight(ray)), waiting, strict=False):
                    running[task.remote(perform, job, self.threads)] = job
                while running:
                    [ended], _ = ray.wait(list(running), num_returns=1)
                    job = running.pop(ended)
                    following = next(waiting, None)
                    if following is not None:
                        reference = task.remote(perform, following, self.threads)
                        running[reference] = following
                    yield get_outcome(ray, ended, job)
            finally:
                for reference in running:
                    ray.cancel(reference)
                if running:
                    ray.wait(list(running), num_returns=len(running), timeout=STOP_SECONDS)

    @contextlib.contextmanager
    def _connect(self) -> Iterator[Any]:
        """Connect to Ray, and shut down a local cluster at the end."""
        ray = import_ray()
        handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            ray.init(log_to_driver=False, logging_level="ERROR", **self._get_init_options())
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise InputError(
                f"There is no cluster of Ray at {quote_value(self.address)}: "
                f"{quote_value(str(error))}.",
                "address",
            ) from error
        try:
            # Ray has replaced them by its own.
            for number, handler in handlers.items():
                signal.signal(number, handler)
            yield ray
        finally:
            ray.shutdown()

    def _get_init_options(self) -> dict[str, Any]:
        if self.address is not None:
            return {"address": self.address}
        cpus = None if self.workers is None else self.workers * self.threads
        return {
            "address": "local",
            "num_cpus": cpus,
            "include_dashboard": False,
            "object_store_memory": STORE_BYTES,
        }

    def _count_in_flight(self, ray: Any) -> int:
        if self.workers is not None:
            return self.workers
        there = int(ray.cluster_resources().get("CPU", 1) // self.threads)
        return IN_FLIGHT * max(1, there)


def import_ray() -> Any:
    """Import Ray; raise InputError if it is not installed."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Suppresses Ray's notice about future versions on standard error.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError as error:
        raise InputError(
            "The engine ray needs a package; install it with `pip install 'gscompleter[ray]'`."
        ) from error
    return ray


def run_remote_job(perform: Perform, job: Job, threads: int) -> Outcome:
    """Run a job in a worker of Ray."""
    limit_threads(threads)  # before the first job imports libraries that read it
    return perform(job)


def get_outcome(ray: Any, reference: Any, job: Job) -> Outcome:
    """Return the outcome of a finished task; raise any error but that of a lost worker."""
    try:
        outcome: Outcome = ray.get(reference)
    except (
        ray.exceptions.WorkerCrashedError,
        ray.exceptions.NodeDiedError,
        ray.exceptions.OutOfMemoryError,
        ray.exceptions.TaskCancelledError,
        ray.exceptions.ObjectLostError,
    ):
        return Outcome(job, "lost")
    return outcome
