"""Tiny jobs on a Ray cluster of several nodes on this machine, which is disturbed on purpose.

    python benchmarks/stress_batch.py OUT --jobs 5000 --nodes 3 --kill-every 5

Workers are killed at random, one node is removed, and writes fail now and then. Afterwards each job
has to be done once, with the bytes of a serial run. Needs the extra `ray`, and Linux.
"""

from __future__ import annotations

import argparse
import errno
import hashlib
import json
import os
import random
import resource
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gscompleter.apps.report.page import write_overview
from gscompleter.system.files.writing import replace_file
from gscompleter.system.jobs.engines import RAY_VARIABLES, open_ray
from gscompleter.system.jobs.jobs import (
    JOBS,
    Job,
    claim_folder,
    find_missing_jobs,
    has_row,
    make_folder,
    read_row,
    run_job,
    run_jobs,
)

RESULT_BYTES = 4096
SCORES = {
    "targets": 1,
    "hole_fraction": 0.1,
    "psnr_before": 20.0,
    "psnr_after": 25.0,
    "coverage_before": 0.8,
    "coverage_after": 1.0,
    "added": 1000,
    "peak_bytes": 5 * 10**8,
}
"""Entries of a row as a completion has them."""


@dataclass(frozen=True)
class Writing:
    """Writes the result of a job, on a disk of which a share of all writes fails."""

    out: Path
    failing: float
    seconds: float
    retries: int

    def __call__(self, job: Job) -> None:
        sync = os.fsync

        def fail_sometimes(file: int) -> None:
            if random.random() < self.failing:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            sync(file)

        os.fsync = fail_sometimes
        try:
            run_job(job, self.out, lambda: self.write(job), self.retries)
        finally:
            os.fsync = sync

    def write(self, job: Job) -> dict[str, Any]:
        start = time.monotonic()
        time.sleep(self.seconds)
        folder = self.out / JOBS / job.name
        make_folder(folder)
        with replace_file(folder / "result") as file:
            file.write(compute_content(job))
        # One line for each time that the job came to its end.
        with (folder / "ends").open("a") as file:
            file.write(f"{os.getpid()}\n")
        return {**SCORES, "seconds": time.monotonic() - start, "result_bytes": RESULT_BYTES}


def compute_content(job: Job) -> bytes:
    return hashlib.shake_256(job.name.encode()).digest(RESULT_BYTES)


def list_processes(ancestor: int, prefix: str) -> Iterator[int]:
    """List the descendants of a process whose command line begins with `prefix`."""
    parents = {}
    lines = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int(
                (folder / "stat").read_text().rsplit(")", 1)[1].split()[1]
            )
            lines[int(folder.name)] = (folder / "cmdline").read_text()
        except (OSError, ValueError):
            continue
    for process in lines:
        above = process
        while above in parents and above != ancestor:
            above = parents[above]
        if above == ancestor and lines[process].startswith(prefix):
            yield process


def disturb(done: threading.Event, seconds: float, counts: dict[str, int]) -> None:
    """Kill a worker of this process's cluster every so many seconds."""
    chance = random.Random(0)
    while not done.wait(seconds):
        if workers := list(list_processes(os.getpid(), "ray::run_task")):
            try:
                os.kill(chance.choice(workers), signal.SIGKILL)
                counts["workers killed"] += 1
            except ProcessLookupError:
                continue


def measure_resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--jobs", type=int, default=5000)
    parser.add_argument("--nodes", type=int, default=3)
    parser.add_argument("--workers-per-node", type=int, default=2)
    parser.add_argument("--kill-every", type=float, default=5.0, help="seconds")
    parser.add_argument("--failing", type=float, default=0.01, help="share of writes that fail")
    parser.add_argument("--seconds", type=float, default=0.0, help="duration of a job")
    given = parser.parse_args()
    # Not imported above, as the variables have to be set before.
    os.environ.update(RAY_VARIABLES)
    import ray
    from ray.cluster_utils import Cluster

    jobs = [Job(f"job-{number:06d}", {"number": number}) for number in range(given.jobs)]
    out = given.out.resolve()
    claim_folder(out, "batch", {"version": 1, "kind": "batch"})
    left = find_missing_jobs(jobs, out, rerun_failed=True)

    node = {"num_cpus": given.workers_per_node, "object_store_memory": 100 * 10**6}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    nodes = [cluster.add_node(**node) for _ in range(given.nodes - 1)]
    counts = {"workers killed": 0, "nodes removed": 0}
    done = threading.Event()
    killer = threading.Thread(target=disturb, args=(done, given.kill_every, counts), daemon=True)
    killer.start()
    perform = Writing(out, given.failing, given.seconds, retries=4)
    engine = partial(open_ray, None, 1, 0.0, cluster.address)
    start = time.monotonic()
    memory = {}
    for number, _ in enumerate(run_jobs(left, perform, partial(has_row, out=out), engine, 4)):
        if number in (len(left) // 10, len(left) - 1):
            memory[number + 1] = measure_resident_bytes()
        if number == len(left) // 2 and nodes:
            cluster.remove_node(nodes.pop(), allow_graceful=False)
            counts["nodes removed"] += 1
    seconds = time.monotonic() - start
    done.set()
    killer.join()
    ray.shutdown()
    cluster.shutdown()

    start = time.monotonic()
    write_overview(out, jobs)
    rows = [read_row(job, out) for job in jobs]
    repeated = sum(len((out / JOBS / job.name / "ends").read_text().split()) > 1 for job in jobs)
    same = sum(
        (out / JOBS / job.name / "result").read_bytes() == compute_content(job) for job in jobs
    )
    unfinished = sum(1 for _ in out.rglob(".*"))
    print(
        json.dumps(
            {
                "jobs": len(jobs),
                "run": len(left),
                "done": sum(row is not None and row["state"] == "done" for row in rows),
                "same bytes": same,
                "ended more than once": repeated,
                "attempts above one": sum(row is not None and row["attempts"] > 1 for row in rows),
                "unfinished files": unfinished,
                **counts,
                "seconds": round(seconds, 1),
                "driver MB by jobs": {k: round(v / 1e6) for k, v in memory.items()},
                "seconds of the tables": round(time.monotonic() - start, 2),
                "index.html bytes": (out / "index.html").stat().st_size,
                "table.csv bytes": (out / "table.csv").stat().st_size,
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
