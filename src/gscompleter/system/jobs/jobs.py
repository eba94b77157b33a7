"""Jobs, and workers that run them until each has a row; the rows of a batch, and its folder.

batch.json          kind and version of the folder (`claim_folder`)
jobs/NAME/          output of `complete`
rows/NAME.json      outcome of the job: state, reason, scores, cost; written last

A worker runs its share of the jobs in order. If it is killed, it was at the first job without a
row: the loss of that job is counted, and the rest of the share is run again.

`evaluate` runs its jobs here, too; its folder and rows are others (`evaluation/store.py`).
"""

from __future__ import annotations

import json
import os
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from gscompleter.system.errors import (
    FullDiskError,
    InputError,
    OutputError,
    WorkerError,
    quote_value,
)
from gscompleter.system.files.reading import read_json
from gscompleter.system.files.unfinished import UNFINISHED_PREFIX, remove_left_behind_below
from gscompleter.system.files.writing import convert_write_errors, replace_file

JOBS = "jobs"
"""Folder of the results of jobs, in the folder of a batch."""
ROWS = "rows"
"""Folder of the rows of jobs, in the folder of a batch."""
ROW_KEYS = {"job", "options", "state"}
"""Keys without which a file is no row; rows have further ones."""
ROW_ADVICE = "delete it and run again"
"""End of each sentence about a damaged row."""
RETRY_SECONDS = 1.0
"""Delay before a retry after an error not caused by the input, for each attempt so far."""
POLL_SECONDS = 0.1
"""Interval between checks of the workers and of the rows."""
SLURM_VARIABLES = ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_COUNT")
"""SLURM variables: number of this task of an array, of the first task, and of tasks."""


@dataclass(frozen=True)
class Job:
    """A piece of work that does not depend on others."""

    name: str
    """Unique name, of its folder and its row."""
    options: Mapping[str, Any] = field(default_factory=dict)
    lost: int = 0
    """Number of workers that were killed while they ran it."""


def run_job(job: Job, out: Path, work: Callable[[], Mapping[str, Any]], retries: int) -> None:
    """Run a job and write its row, unless it has one.

    `work` returns further entries of the row. It is repeated after a killed worker or any error
    other than InputError, at most `retries` times. A full disk, or one that still cannot be written
    after as many attempts, is no fault of the job: it raises OutputError, which ends the run.
    """
    if not has_row(job, out):
        row = {"job": job.name, "options": dict(job.options)}
        row |= run_with_retries(work, job.lost, retries)
        write_row(get_row_path(job, out), row, retries)


def write_row(path: Path, row: Mapping[str, Any], retries: int) -> None:
    """Write a row, at most `retries` times again where the disk cannot be written for a moment."""
    for number in range(1, retries + 2):
        try:
            write_json(path, row)
            return
        except OutputError as error:
            if isinstance(error, FullDiskError) or number > retries:
                raise
        time.sleep(RETRY_SECONDS * number)


def run_with_retries(
    work: Callable[[], Mapping[str, Any]], lost: int, retries: int
) -> dict[str, Any]:
    """Run `work` with retries and return its part of a row; `lost` attempts have been killed.

    It raises OutputError alone, as `run_job` does.
    """
    # Attempts that killed their process count, too.
    reason = describe_loss(lost)
    for number in range(lost + 1, retries + 2):
        try:
            return {"state": "done", "reason": None, "attempts": number, **work()}
        except OutputError as error:
            # A network disk that fails for a moment is written again; a full one stays full.
            if isinstance(error, FullDiskError) or number > retries:
                raise
        except InputError as error:
            return {"state": "failed", "reason": str(error), "attempts": number}
        except Exception as error:  # one broken job must not stop the others
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        if number <= retries:
            time.sleep(RETRY_SECONDS * number)
    return {"state": "failed", "reason": reason, "attempts": max(lost, retries + 1)}


def describe_loss(lost: int) -> str:
    """Describe why a job whose workers were killed has no result."""
    times = "once" if lost == 1 else f"{lost} times"
    return f"its process was killed {times}, perhaps because memory ran out"


def get_row_path(job: Job, out: Path) -> Path:
    """Return the path of a row."""
    return out / ROWS / f"{job.name}.json"


def has_row(job: Job, out: Path) -> bool:
    """Return True if the job has ended, done or failed."""
    return get_row_path(job, out).is_file()


def read_row(job: Job, out: Path) -> dict[str, Any] | None:
    """Read the row of a job, or return None if there is none; raise InputError if it is damaged."""
    if not has_row(job, out):
        return None
    path = get_row_path(job, out)
    row = read_json(path, ROW_ADVICE)
    if not isinstance(row, dict) or not row.keys() >= ROW_KEYS:
        raise InputError(f"{quote_value(path)} is no row of a job; {ROW_ADVICE}.")
    return row


def find_missing_jobs(jobs: Sequence[Job], out: Path, rerun_failed: bool) -> list[Job]:
    """Return the jobs to run: those without a row, and failed ones whose rows are then removed.

    A failed job is run again with `rerun_failed`, or if it has other options than before.

    Raises:
        InputError: A job is done with other options, or its row is damaged.
    """
    left = []
    for job in jobs:
        row = read_row(job, out)
        is_other = row is not None and row["options"] != dict(job.options)
        if row is not None and row["state"] == "done" and is_other:
            raise InputError(
                f"{quote_value(out)} holds the job {quote_value(job.name)} done with other "
                "options; give the row another name, or name another folder."
            )
        if row is None or (row["state"] == "failed" and (rerun_failed or is_other)):
            left.append(job)
            get_row_path(job, out).unlink(missing_ok=True)
    return left


def claim_folder(out: Path, kind: str, content: Mapping[str, Any]) -> None:
    """Write `KIND.json` before all other files of a folder, unless it exists.

    Several processes may do so simultaneously. InputError is raised if the folder has other files,
    or a link out of it, through which results would be written elsewhere.
    """
    marker = out / f"{kind}.json"
    try:
        names = [path.name for path in out.iterdir()]
    except FileNotFoundError:
        names = []
    except OSError as error:
        raise InputError(
            f"{quote_value(out)} cannot be read: {error.strerror}; name another."
        ) from error
    # Listed first, as another process may be writing the marker.
    is_used = any(not name.startswith(UNFINISHED_PREFIX) for name in names)
    if is_used and not marker.is_file():
        raise InputError(f"{quote_value(out)} holds something other than a {kind}; name another.")
    refuse_links_out(out)
    remove_left_behind_below(out)
    write_json(marker, content, keep_existing=True)


def refuse_links_out(out: Path) -> None:
    """Raise InputError if a folder, or one in it, has a link that leads out of it."""
    root = Path(os.path.realpath(out))
    waiting = [root]
    while waiting:
        try:
            entries = list(os.scandir(waiting.pop()))
        except OSError:  # another shard removes folders that a killed run left
            continue
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                waiting.append(Path(entry.path))
            elif entry.is_symlink() and root not in Path(os.path.realpath(entry.path)).parents:
                raise InputError(
                    f"{quote_value(Path(entry.path))} is a link out of the folder of the results; "
                    "remove it, or name another folder.",
                    "out",
                )


def make_folder(folder: Path) -> None:
    """Create a folder with its parents; raise OutputError if that fails."""
    with convert_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)


def write_json(path: Path, content: Any, keep_existing: bool = False) -> None:
    """Write JSON atomically; the arguments are those of `replace_file`."""
    make_folder(path.parent)
    with replace_file(path, keep_existing) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


Perform = Callable[[Job], None]
"""Runs a job in any process and writes its row, unless it has one."""


WorkerShare = Callable[[], Exception | None]
"""Runs the jobs of one worker; returns the error that ends the whole run, such as a full disk."""


@dataclass(frozen=True)
class Pool:
    """The workers of an engine."""

    size: int
    """Number of shares that run simultaneously."""
    start: Callable[[WorkerShare], Any]
    """Starts a share; returns its future, with `done()`, `exception()` and `result()`."""
    num_shares: int | None = None
    """Number of shares to divide the jobs into; None makes one of each job."""


Engine = Callable[[], AbstractContextManager[Pool]]
"""Opens a pool, whose workers are stopped at the end of the block."""


def run_share(perform: Perform, jobs: Sequence[Job]) -> Exception | None:
    """Run the jobs of a `WorkerShare` in order."""
    try:
        for job in jobs:
            perform(job)
    except Exception as error:  # engines do not all hand over what is raised
        return error
    return None


def run_jobs(
    jobs: Sequence[Job],
    perform: Perform,
    has_row: Callable[[Job], bool],
    engine: Engine | None = None,
    retries: int = 0,
) -> Iterator[Job]:
    """Run jobs until each has a row, and yield them in the order in which they end.

    Without an engine they run in this process. A job that cost its worker more than `retries` times
    is performed once more with this number in `lost`, and then has to write a row of a failure.
    Whatever ended a worker's share is raised, and WorkerError if none can start.
    """
    if engine is None:
        for job in jobs:
            perform(job)
            yield job
        return
    running: dict[Any, list[Job]] = {}
    with engine() as pool:
        # Every n-th job, as in `parse_shard`.
        count = min(pool.num_shares or len(jobs), len(jobs))
        waiting = deque(list(jobs[i::count]) for i in range(count))
        while waiting or running:
            while waiting and len(running) < pool.size:
                share = waiting.popleft()
                running[pool.start(partial(run_share, perform, tuple(share)))] = share
            time.sleep(POLL_SECONDS)
            # Asked before the rows are looked at: a share that has ended has written all of them.
            ended = [future for future in running if future.done()]
            for share in running.values():
                while share and has_row(share[0]):
                    yield share.pop(0)
            for future in ended:
                share = running.pop(future)
                rest = collect_rest(future, share, retries)
                if rest:
                    waiting.append(rest)
                else:
                    # Nothing, unless a network disk shows rows of another machine later.
                    yield from share


def collect_rest(future: Any, share: list[Job], retries: int) -> list[Job]:
    """Return what a killed worker left of its share, with the loss of the first job counted.

    It raises the error of a worker, which ends the run, and WorkerError where one was lost that
    only had to list a job as failed: then no worker can start.
    """
    killed = future.exception()
    if killed is None:
        error = future.result()
        if error is not None:
            raise error
        return []
    if not share:
        return []
    first = replace(share[0], lost=share[0].lost + 1)
    if first.lost > retries + 1:
        raise WorkerError(
            f"Processes of the engine cannot start, or end at once ({type(killed).__name__}: "
            f"{quote_value(str(killed))}); mend what they print above."
        ) from killed
    return [first, *share[1:]]


def parse_shard(text: str | None, environment: Mapping[str, str]) -> tuple[int, int]:
    """Parse `i/n` (the jobs i, i + n, …), or `auto` in a SLURM array; None means all jobs.

    `environment` has the variables of SLURM. The numbers of the array have to be consecutive.

    Raises:
        InputError: There is no such shard, or no array.
    """
    if text is None:
        return 0, 1
    if text == "auto":
        numbers = [environment.get(name, "") for name in SLURM_VARIABLES]
        named = zip(SLURM_VARIABLES, numbers, strict=True)
        if lacking := [name for name, number in named if not number.isdecimal()]:
            raise InputError(
                f"{' and '.join(lacking)} {'is' if len(lacking) == 1 else 'are'} not set to a "
                "number, so this is no SLURM array; give the shard as i/n.",
                "shard",
            )
        task, first, count = map(int, numbers)
        return check_shard(task - first, count)
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if match is None:
        return check_shard(-1, 0)
    return check_shard(int(match[1]), int(match[2]))


def check_shard(number: int, count: int) -> tuple[int, int]:
    """Return the shard, or raise InputError if it is impossible."""
    if not 0 <= number < count:
        raise InputError(
            "There is no such shard; give i/n: of four shards the first is 0/4, the last 3/4.",
            "shard",
        )
    return number, count
