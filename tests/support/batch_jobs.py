"""Jobs that write a line and a result, for workers that may be killed by them."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gscompleter.system.errors import InputError
from gscompleter.system.files.writing import replace_file
from gscompleter.system.jobs.engines import open_local, open_ray
from gscompleter.system.jobs.jobs import (
    JOBS,
    Engine,
    Job,
    Pool,
    WorkerShare,
    find_missing_jobs,
    has_row,
    make_folder,
    run_job,
    run_jobs,
)


@contextmanager
def open_here(workers: int) -> Iterator[Pool]:
    """Open a pool whose shares run in this process: no other has to start."""

    def start(share: WorkerShare) -> Future[Exception | None]:
        future: Future[Exception | None] = Future()
        future.set_result(share())
        return future

    yield Pool(workers, start)


@dataclass(frozen=True)
class Writing:
    """Runs a job for `seconds`, and ends it as `ends` names."""

    out: Path
    retries: int = 2

    def __call__(self, job: Job) -> None:
        run_job(job, self.out, lambda: self.written(job), self.retries)

    def written(self, job: Job) -> dict[str, Any]:
        folder = self.out
        noted(folder / "begun" / job.name)
        time.sleep(job.options.get("seconds", 0.0))
        ends = job.options.get("ends")
        times = len((folder / "begun" / job.name).read_text().split())
        if ends == "always killed" or (ends == "killed once" and times == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if ends == "sentence":
            raise InputError("The scene is broken; mend it.")
        if ends == "defect" or (ends == "defect once" and times == 1):
            raise KeyError("a defect")
        content = hashlib.sha256(job.name.encode()).hexdigest().encode()
        make_folder(folder / JOBS / job.name)
        with replace_file(folder / JOBS / job.name / "result") as file:
            file.write(content)
        noted(folder / "ended" / job.name)
        return {"size": len(content)}


def noted(path: Path) -> None:
    """Append a line with the id of this process."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(f"{os.getpid()}\n")


def run_all(out: Path, jobs: Sequence[Job], engine: Engine | None, retries: int = 2) -> list[str]:
    """Run the jobs without a row, and return their names in the order in which they ended."""
    left = find_missing_jobs(jobs, out, rerun_failed=False)
    ended = run_jobs(left, Writing(out, retries), partial(has_row, out=out), engine, retries)
    return [job.name for job in ended]


def engine_named(name: str, workers: int) -> Engine:
    return partial(open_local, workers) if name == "local" else partial(open_ray, workers, 1)


def plain_jobs(count: int, seconds: float) -> list[Job]:
    return [Job(f"job-{number:03d}", {"seconds": seconds}) for number in range(count)]


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    engine, out, count, seconds, workers = sys.argv[1:]
    jobs = plain_jobs(int(count), float(seconds))
    run_all(Path(out), jobs, engine_named(engine, int(workers)))
