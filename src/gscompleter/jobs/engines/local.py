"""Local processes, each in its own pool, so that a killed one affects no other."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from threading import Lock, Thread

from gscompleter.cpu_threads import count_available_cores
from gscompleter.jobs.jobs import Job, Outcome, Perform
from gscompleter.memory import estimate_bytes, read_memory_bytes

PIXELS, IMAGES = 640 * 480, 8
"""Size of a typical completion, for the default number of workers."""
WATCH_SECONDS = 0.5
"""Interval at which a worker checks whether it has to stop."""
CLEANING_SECONDS = 20.0
"""Time that it then has to release its claim."""


def choose_num_workers() -> int:
    """Return the number of cores, limited by the memory of a typical completion."""
    there = read_memory_bytes()
    fitting = count_available_cores() if there is None else there // estimate_bytes(PIXELS, IMAGES)
    return max(1, min(count_available_cores(), fitting))


@dataclass(frozen=True)
class LocalEngine:
    """Workers that are local processes."""

    workers: int

    def __call__(self, perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Run jobs as `Engine` does."""
        stop = multiprocessing.get_context("spawn").Event()
        waiting = iter(jobs)
        running: dict[Future[Outcome], tuple[ProcessPoolExecutor, Job]] = {}
        try:
            for _, job in zip(range(self.workers), waiting, strict=False):
                submit_job(perform, job, start_worker(stop), running)
            while running:
                ended, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in ended:
                    executor, job = running.pop(future)
                    outcome = get_outcome(future, job)
                    following = next(waiting, None)
                    if outcome.state == "lost" or following is None:
                        executor.shutdown(wait=False)
                    if following is not None:
                        again = start_worker(stop) if outcome.state == "lost" else executor
                        submit_job(perform, following, again, running)
                    yield outcome
        finally:
            stop.set()
            for executor, _ in running.values():
                executor.shutdown(cancel_futures=True)


def submit_job(
    perform: Perform,
    job: Job,
    executor: ProcessPoolExecutor,
    running: dict[Future[Outcome], tuple[ProcessPoolExecutor, Job]],
) -> None:
    """Submit a job to a worker."""
    running[executor.submit(run_job, perform, job)] = executor, job


def get_outcome(future: Future[Outcome], job: Job) -> Outcome:
    """Return the outcome of a finished job; raise any error but that of a killed worker."""
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, (BrokenProcessPool, KeyboardInterrupt)):
        return Outcome(job, "lost")
    raise error


def start_worker(stop: Event) -> ProcessPoolExecutor:
    """Start a process that ends with `stop` or with this process."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, context, begin_worker, (stop,))


_busy = Lock()
"""Held by a worker while it runs a job."""


def run_job(perform: Perform, job: Job) -> Outcome:
    """Run a job in this worker."""
    with _busy:
        return perform(job)


def begin_worker(stop: Event) -> None:
    """Initialize a worker: ignore Ctrl-C, which is for the parent, and watch `stop`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    Thread(target=watch_parent, args=(stop,), daemon=True).start()


def watch_parent(stop: Event) -> None:
    """End this process when it has to stop or its parent is gone; a job releases its claim."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    while parent.is_alive() and not stop.is_set():
        time.sleep(WATCH_SECONDS)
    if not _busy.acquire(blocking=False):
        os.kill(os.getpid(), signal.SIGTERM)
        _busy.acquire(timeout=CLEANING_SECONDS)
    os._exit(0)
