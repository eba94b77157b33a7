"""Engines, which start workers: local processes, Ray tasks, or SLURM jobs through submitit."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from gscompleter.cpu_threads import count_available_cores, limit_threads
from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import handle_stop_signals
from gscompleter.jobs.jobs import Job
from gscompleter.jobs.workers import Engine, Pool, Share
from gscompleter.memory import estimate_bytes, read_memory_bytes

EngineName = Literal["local", "ray", "submitit"]

PIXELS, IMAGES = 640 * 480, 8
"""Size of a typical completion, for the default number of workers."""
STOP_SECONDS = 20.0
"""Time that stopped workers have to remove what they have not finished."""
RAY_VARIABLES = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
"""Variables against messages to Ray's makers, and of Ray on standard error."""
STORE_BYTES = 200 * 10**6
"""Memory for return values in a local Ray cluster; they are small, as results are files."""


def choose_num_workers() -> int:
    """Return the number of cores, limited by the memory of a typical completion."""
    there = read_memory_bytes()
    fitting = count_available_cores() if there is None else there // estimate_bytes(PIXELS, IMAGES)
    return max(1, min(count_available_cores(), fitting))


@dataclass(frozen=True)
class LocalEngine(Engine):
    """Workers that are local processes."""

    workers: int

    @contextlib.contextmanager
    def open(self) -> Iterator[Pool]:
        """Open a pool of processes, which end with this one."""
        workers: list[LocalWorker] = []

        def start(share: Share) -> LocalWorker:
            idle = [worker for worker in workers if worker.is_idle()]
            if not idle:
                idle = [LocalWorker()]
                workers.extend(idle)
            idle[0].start(share)
            return idle[0]

        try:
            yield Pool(self.workers, start)
        finally:
            for worker in workers:
                worker.process.terminate()
            for worker in workers:
                worker.process.join(STOP_SECONDS)
                worker.process.kill()


class LocalWorker:
    """A process that runs one share after the other, and the future of the running one."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=run_process, args=(theirs,))
        self.process.start()
        theirs.close()
        self.is_running = False
        self.error: Exception | None = None

    def is_idle(self) -> bool:
        """Return True if a share can be started."""
        return not self.is_running and self.process.is_alive()

    def start(self, share: Share) -> None:
        """Start a share."""
        self.is_running = True
        self.connection.send(share)

    def done(self) -> bool:
        """Return True if the share has been run, or the process has ended."""
        return self.connection.poll()

    def exception(self) -> Exception | None:
        """Return an error if the process was killed, or None."""
        self.is_running = False
        try:
            self.error = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            return RuntimeError(f"a worker ended with exit code {self.process.exitcode}")
        return None

    def result(self) -> Exception | None:
        """Return the result of the share."""
        return self.error


def run_process(connection: Connection) -> None:
    """Run shares in this process until the parent is gone or stops it.

    Ctrl-C is for the parent. What is running when the parent is killed is still finished.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    handle_stop_signals()
    with contextlib.suppress(KeyboardInterrupt, EOFError, ConnectionError):
        while True:
            share: Share = connection.recv()
            connection.send(share())


def import_engine(package: str, extra: str) -> Any:
    """Import the package of an engine; raise InputError if it is not installed."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(
            f"The engine {package} needs a package; install it with "
            f"`pip install 'gscompleter[{extra}]'`."
        ) from error


@dataclass(frozen=True)
class RayEngine(Engine):
    """Workers that are Ray tasks."""

    workers: int | None
    """Number of simultaneous tasks; None uses all of the cluster."""
    threads: int
    gpus: float = 0.0
    """GPUs per task, possibly a fraction."""
    address: str | None = None
    """Address of a cluster; None starts one on this machine."""

    @contextlib.contextmanager
    def open(self) -> Iterator[Pool]:
        """Connect to Ray, or start a local cluster, and open a pool of tasks."""
        ray = import_engine("ray", "ray")
        self._connect(ray)
        # A lost task is not repeated by Ray, so that its attempts are counted.
        task = ray.remote(run_task).options(
            num_cpus=self.threads, num_gpus=self.gpus, max_retries=0
        )
        started: list[Any] = []

        def start(share: Share) -> Any:
            started.append(task.remote(share, self.threads))
            return started[-1].future()

        try:
            cores = int(ray.cluster_resources().get("CPU", 1) // self.threads)
            yield Pool(self.workers or max(1, cores), start)
            started.clear()
        finally:
            for reference in started:
                ray.cancel(reference)
            if started:
                ray.wait(started, num_returns=len(started), timeout=STOP_SECONDS)
            ray.shutdown()

    def _connect(self, ray: Any) -> None:
        for name, value in RAY_VARIABLES.items():
            os.environ.setdefault(name, value)
        cpus = None if self.workers is None else self.workers * self.threads
        here = {"num_cpus": cpus, "include_dashboard": False, "object_store_memory": STORE_BYTES}
        options = {"address": self.address} if self.address else {"address": "local", **here}
        handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            ray.init(log_to_driver=False, logging_level="ERROR", **options)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise InputError(
                f"There is no cluster of Ray at {quote_value(self.address)}: "
                f"{quote_value(str(error))}.",
                "address",
            ) from error
        for number, handler in handlers.items():  # Ray has replaced them by its own
            signal.signal(number, handler)


def run_task(share: Share, threads: int) -> Exception | None:
    """Run a share in a Ray task or a SLURM job."""
    limit_threads(threads)  # before the first job imports libraries that read it
    return share()


@dataclass(frozen=True)
class SubmititEngine(Engine):
    """Workers that are SLURM jobs, or local processes without SLURM."""

    workers: int
    threads: int
    gpus: float
    folder: Path
    """Folder for submitit's files and the output of the jobs."""
    parameters: Mapping[str, str]
    """Further SLURM parameters such as `partition` and `time`."""

    def divide(self, jobs: Sequence[Job]) -> list[list[Job]]:
        """Divide jobs into one share for each worker."""
        return [list(jobs[i :: self.workers]) for i in range(min(self.workers, len(jobs)))]

    @contextlib.contextmanager
    def open(self) -> Iterator[Pool]:
        """Open a pool of SLURM jobs."""
        executor, started = self._make_executor(), []

        def start(share: Share) -> Any:
            started.append(executor.submit(SlurmTask(self.threads), share))
            return started[-1]

        try:
            yield Pool(self.workers, start)
        finally:
            for job in started:
                with contextlib.suppress(Exception):  # it may have ended
                    job.cancel()

    def _make_executor(self) -> Any:
        submitit = import_engine("submitit", "slurm")
        executor = submitit.AutoExecutor(folder=str(self.folder))
        further: dict[str, Any] = {f"slurm_{k}": v for k, v in self.parameters.items()}
        if executor.cluster == "local":
            further = {"timeout_min": 24 * 60}
        try:
            executor.update_parameters(
                cpus_per_task=self.threads,
                gpus_per_node=int(self.gpus),
                name="gscompleter",
                **further,
            )
        except (ValueError, NameError, TypeError) as error:
            raise InputError(
                f"A parameter of SLURM is invalid: {quote_value(str(error))}; correct it."
            ) from error
        return executor


@dataclass(frozen=True)
class SlurmTask:
    """Runs a share in a SLURM job."""

    threads: int

    def __call__(self, share: Share) -> Exception | None:
        """Run the share."""
        handle_stop_signals()
        return run_task(share, self.threads)

    def checkpoint(self, share: Share) -> Any:
        """Resubmit the share if SLURM preempts the job; jobs with a row are skipped."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, share)
