"""Processes of this machine, each a `ProcessPoolExecutor` of one, so that one that is killed takes
no other along."""

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

from gscompleter.batch.jobs import Job, Outcome, Perform
from gscompleter.memory import memory_bytes, needed_bytes
from gscompleter.threads import usable_cores

PIXELS, IMAGES = 640 * 480, 8
"""Of a completion as most are, by which the number of workers is chosen."""
WATCH_SECONDS = 0.5
"""How often a worker looks whether it is to stop."""
CLEANING_SECONDS = 20.0
"""How long it may then take to give its claim back."""


def default_workers() -> int:
    """As many workers as there are cores, if each finds the memory of a usual completion."""
    there = memory_bytes()
    fitting = usable_cores() if there is None else there // needed_bytes(PIXELS, IMAGES)
    return max(1, min(usable_cores(), fitting))


@dataclass(frozen=True)
class LocalEngine:
    """Workers that are processes of this machine."""

    workers: int

    def __call__(self, perform: Perform, jobs: Iterable[Job]) -> Iterator[Outcome]:
        stop = multiprocessing.get_context("spawn").Event()
        waiting = iter(jobs)
        running: dict[Future[Outcome], tuple[ProcessPoolExecutor, Job]] = {}
        try:
            for _, job in zip(range(self.workers), waiting, strict=False):
                send(perform, job, worker(stop), running)
            while running:
                ended, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in ended:
                    executor, job = running.pop(future)
                    outcome = outcome_of(future, job)
                    following = next(waiting, None)
                    if outcome.state == "lost" or following is None:
                        executor.shutdown(wait=False)
                    if following is not None:
                        again = worker(stop) if outcome.state == "lost" else executor
                        send(perform, following, again, running)
                    yield outcome
        finally:
            stop.set()
            for executor, _ in running.values():
                executor.shutdown(cancel_futures=True)


def send(
    perform: Perform,
    job: Job,
    executor: ProcessPoolExecutor,
    running: dict[Future[Outcome], tuple[ProcessPoolExecutor, Job]],
) -> None:
    """Let a worker do a job."""
    running[executor.submit(busy_with, perform, job)] = executor, job


def outcome_of(future: Future[Outcome], job: Job) -> Outcome:
    """What became of the job of `future`, which is over.

    Raises whatever ended the worker's work but being killed or told to stop.
    """
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, (BrokenProcessPool, KeyboardInterrupt)):
        return Outcome(job, "lost")
    raise error


def worker(stop: Event) -> ProcessPoolExecutor:
    """One more process, which ends with `stop` and with this process, however that ends."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, context, begin_worker, (stop,))


_busy = Lock()
"""Held by a worker while it does a job."""


def busy_with(perform: Perform, job: Job) -> Outcome:
    """Do a job in this worker."""
    with _busy:
        return perform(job)


def begin_worker(stop: Event) -> None:
    """Prepare this process: Ctrl-C is for those who started it, and `stop` reaches its jobs."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    Thread(target=watch, args=(stop,), daemon=True).start()


def watch(stop: Event) -> None:
    """End this process once it is to stop, or nobody waits for it; a job gives its claim back."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    while parent.is_alive() and not stop.is_set():
        time.sleep(WATCH_SECONDS)
    if not _busy.acquire(blocking=False):
        os.kill(os.getpid(), signal.SIGTERM)
        _busy.acquire(timeout=CLEANING_SECONDS)
    os._exit(0)
