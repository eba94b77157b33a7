"""Engines, which start workers: local processes, Ray tasks, or SLURM jobs through submitit.

Each `open_…` yields a `Pool`. Its `start` takes a share, the callable that one worker runs, and
returns a future of the exception that ended the share, or of None.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

from gscompleter.system.children import hide_working_folder
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.interrupts import handle_stop_signals
from gscompleter.system.jobs.jobs import Pool, WorkerShare
from gscompleter.system.memory import estimate_bytes, read_memory_bytes
from gscompleter.system.threads import count_available_cores, limit_threads

PIXELS = 640 * 480
"""Pixels per image of a typical completion; its memory limits the default number of workers."""
TYPICAL_IMAGES = 8
"""Images of a typical completion."""
STOP_SECONDS = 10.0
"""Time, in seconds, that stopped workers have to remove what they have not finished."""
MAX_REFERENCES = 1000
"""Tasks of Ray, ended ones included, from which on the ended ones are forgotten."""
RAY_VARIABLES = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
"""Environment of Ray. The first variable turns off usage reports to its makers, the second a
warning on standard error."""
STORE_BYTES = 200 * 10**6
"""Memory, in bytes, for return values in a local Ray cluster. Results are files, so that return
values are small."""


def choose_num_workers() -> int:
    """Return the number of cores, limited by the memory of a typical completion."""
    memory = read_memory_bytes()
    cores = count_available_cores()
    if memory is None:
        return cores
    return max(1, min(cores, memory // estimate_bytes(PIXELS, TYPICAL_IMAGES)))


def check_processes() -> None:
    """Refuse to start processes on a machine without shared memory, which their queues need."""
    try:
        # The first lock starts a process that watches over all of them.
        with hide_working_folder():
            multiprocessing.get_context("spawn").Lock()
    except (OSError, ImportError) as error:
        raise InputError(
            f"Processes of this machine need shared memory in /dev/shm, which is missing or cannot "
            f"be written ({quote_value(getattr(error, 'strerror', None) or str(error))}); mount "
            "it, or choose another engine.",
            "engine",
        ) from error


@contextlib.contextmanager
def open_local(workers: int) -> Iterator[Pool]:
    """Open a pool of local processes, which end with this one.

    They compute with as many threads as this one, whose limit is in the environment.
    """
    # One executor for each process: a killed process breaks its whole executor. A broken one, whose
    # future has an exception, is not used again.
    futures: dict[ProcessPoolExecutor, Future[Exception | None]] = {}
    spawn = multiprocessing.get_context("spawn")

    def start(share: WorkerShare) -> Future[Exception | None]:
        idle = [
            executor
            for executor, future in futures.items()
            if future.done() and future.exception() is None
        ]
        for executor in idle:
            # Its process may have been killed since it ended its share.
            with contextlib.suppress(BrokenProcessPool):
                futures[executor] = executor.submit(share)
                return futures[executor]
        begin = partial(begin_worker, os.getcwd())
        with hide_working_folder():
            executor = ProcessPoolExecutor(1, spawn, begin)
            futures[executor] = executor.submit(share)
        return futures[executor]

    try:
        yield Pool(workers, start)
    finally:
        for executor, future in futures.items():
            # `shutdown` waits for running work, so that its processes are stopped first.
            if not future.done():
                for process in executor._processes.values():
                    process.terminate()
        for executor in futures:
            executor.shutdown()


def begin_worker(folder: str) -> None:
    """Work in a folder, and end with the parent, which alone reacts to Ctrl-C."""
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    handle_stop_signals()
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Wait for the end of the parent, and then stop this process as SIGTERM does.

    A process that does not clean up in time is ended without.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(STOP_SECONDS)
    os._exit(1)


def import_engine(package: str, extra: str) -> Any:
    """Import the package of an engine; raise InputError if it is not installed."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(
            f"The engine {package} needs a package; install it with "
            f"`pip install 'gscompleter[{extra}]'`."
        ) from error


@contextlib.contextmanager
def open_ray(
    workers: int | None, threads: int, gpus: float = 0.0, address: str | None = None
) -> Iterator[Pool]:
    """Connect to the cluster at `address`, or start one here, and open a pool of tasks.

    Without a number of workers, tasks fill the cluster. `threads` and `gpus`, possibly a fraction,
    are those of one task.
    """
    ray = import_engine("ray", "ray")
    connect_to_ray(ray, address, None if workers is None else workers * threads)
    # A lost task is not repeated by Ray, so that its attempts are counted.
    task = ray.remote(run_task).options(num_cpus=threads, num_gpus=gpus, max_retries=0)
    started: list[Any] = []

    def start(share: WorkerShare) -> Any:
        # References keep what they refer to: of a million tasks only the running ones are kept.
        if len(started) > MAX_REFERENCES:
            started[:] = ray.wait(started, num_returns=len(started), timeout=0)[1]
        started.append(task.remote(share, threads, os.getcwd()))
        return started[-1].future()

    try:
        resources = ray.cluster_resources()
        # A cluster elsewhere may get further machines when a task waits for them.
        if address is None:
            check_resources(resources, threads, gpus)
        cores = int(resources.get("CPU", 1) // threads)
        yield Pool(workers or max(1, cores), start)
        # All is done, and nothing is left to cancel. Only an exception skips this line.
        started.clear()
    finally:
        for reference in started:
            ray.cancel(reference)
        if started:
            ray.wait(started, num_returns=len(started), timeout=STOP_SECONDS)
        ray.shutdown()


def connect_to_ray(ray: Any, address: str | None, cores: int | None) -> None:
    """Connect to a cluster, or start one of `cores` cores on this machine, all if None.

    Raise InputError if that fails. Ctrl-C and SIGTERM do afterwards what they did before.
    """
    for name, value in RAY_VARIABLES.items():
        os.environ.setdefault(name, value)
    # A cluster elsewhere has its own settings.
    here = {"num_cpus": cores, "include_dashboard": False, "object_store_memory": STORE_BYTES}
    options = {"address": address} if address else {"address": "local", **here}
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        with hide_working_folder():
            ray.init(log_to_driver=False, logging_level="ERROR", **options)
    # A machine that is too busy to start Ray in time makes it raise a plain Exception.
    except Exception as error:
        reason = quote_value(str(error))
        if address is None:
            raise InputError(f"Ray cannot start on this machine: {reason}.", "engine") from error
        raise InputError(
            f"There is no cluster of Ray at {quote_value(address)}: {reason}.", "address"
        ) from error
    finally:
        for number, handler in handlers.items():  # Ray has replaced them by its own
            signal.signal(number, handler)


def check_resources(resources: Mapping[str, float], threads: int, gpus: float) -> None:
    """Raise InputError if this machine cannot run one task of Ray, which would wait without end.

    `resources` are those of a cluster that was started here.
    """
    for name, title, needed, option in (
        ("CPU", "CPU cores", threads, "threads"),
        ("GPU", "GPUs", gpus, "gpus"),
    ):
        available = resources.get(name, 0)
        if needed > available:
            raise InputError(
                f"{title} that Ray finds on this machine: {available:g}, too few for a worker with "
                f"{needed:g}; ask for fewer.",
                option,
            )


def run_task(share: WorkerShare, threads: int, folder: str) -> Exception | None:
    """Run a share in a Ray task or a SLURM job, on `threads` threads, in a working folder."""
    with contextlib.suppress(OSError):  # a machine elsewhere may not have it
        os.chdir(folder)
    limit_threads(threads)  # before the first job imports libraries that read it
    return share()


@contextlib.contextmanager
def open_submitit(
    workers: int, threads: int, gpus: float, folder: Path, parameters: Mapping[str, str]
) -> Iterator[Pool]:
    """Open a pool of SLURM jobs, or of local processes without SLURM.

    Each worker gets one share of all that is to be run, since a job of SLURM waits in a queue.
    `threads` and `gpus` are those of one job. `folder` is for files and output of the jobs;
    `parameters` are further ones of SLURM, such as `partition` and `time`.

    Raises:
        InputError: SLURM cannot give a fraction of a GPU, there is no SLURM to follow the
            parameters, or it refuses them or a job.
    """
    if gpus != int(gpus):
        raise InputError(
            f"A job of SLURM gets whole GPUs, and {gpus:g} was asked for; give a whole number.",
            "gpus",
        )
    submitit = import_engine("submitit", "slurm")
    executor = submitit.AutoExecutor(folder=str(folder))
    further: dict[str, Any] = {f"slurm_{name}": value for name, value in parameters.items()}
    if executor.cluster == "local":
        if parameters:
            raise InputError(
                "These are parameters of SLURM, which this machine does not have (no srun); run "
                "the command where it is, or leave them out to use processes of this machine.",
                "slurm",
            )
        # The limit of time of local processes is one day.
        further = {"timeout_min": 24 * 60}
    resources = {"cpus_per_task": threads, "gpus_per_node": int(gpus), "name": "gscompleter"}
    try:
        executor.update_parameters(**resources, **further)
    except (ValueError, NameError, TypeError) as error:
        raise InputError(
            f"A parameter of SLURM is invalid: {quote_value(str(error))}; correct it."
        ) from error
    started: list[Any] = []

    def start(share: WorkerShare) -> Any:
        task = partial(run_task, share, threads, os.getcwd())
        try:
            with hide_working_folder():
                started.append(executor.submit(task))
        except (submitit.core.utils.FailedJobError, FileNotFoundError) as error:
            raise InputError(
                f"SLURM took no job: {quote_value(str(error))}; mend what it names, or try again."
            ) from error
        return started[-1]

    try:
        yield Pool(workers, start, num_shares=workers)
    finally:
        for job in started:
            with contextlib.suppress(Exception):  # it may have ended
                job.cancel()
