"""Jobs, and their rows in the folder of a batch.

batch.json          kind and version of the folder
jobs/NAME/          output of `complete`
rows/NAME.json      outcome of the job: state, reason, scores, cost; written last
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError, OutputError, quote_value
from gscompleter.io.files import UNFINISHED_PREFIX, replace_file
from gscompleter.io.reading import read_json

BATCH, JOBS, ROWS = "batch.json", "jobs", "rows"
"""File that marks the folder of a batch, and its folders."""
RETRY_SECONDS = 1.0
"""Delay before the first retry after an error not caused by the input; doubled for the next."""


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
    other than InputError, at most `retries` times.
    """
    if not has_row(job, out):
        row = {"job": job.name, "options": dict(job.options)}
        write_json(get_row_path(job, out), row | run_with_retries(work, job.lost, retries))


def run_with_retries(
    work: Callable[[], Mapping[str, Any]], lost: int, retries: int
) -> dict[str, Any]:
    """Run `work` with retries and return its part of a row; `lost` attempts have been killed."""
    reason = describe_loss(lost)
    for number in range(lost + 1, retries + 2):
        try:
            return {"state": "done", "reason": None, "attempts": number, **work()}
        except OutputError:
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
    return f"its process was killed {lost} times, perhaps because memory ran out"


def get_row_path(job: Job, out: Path) -> Path:
    """Return the path of the row of a job."""
    return out / ROWS / f"{job.name}.json"


def has_row(job: Job, out: Path) -> bool:
    """Return True if the job has ended, done or failed."""
    return get_row_path(job, out).is_file()


def read_row(job: Job, out: Path) -> dict[str, Any] | None:
    """Read the row of a job, or return None if there is none."""
    if not has_row(job, out):
        return None
    return dict(read_json(get_row_path(job, out), "delete it and run again"))


def find_missing_jobs(jobs: Sequence[Job], out: Path, rerun_failed: bool) -> list[Job]:
    """Return jobs without a row, and remove the failed rows to repeat (new options, or `rerun`).

    Raises:
        InputError: A job was done with other options.
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


def claim_folder(out: Path) -> None:
    """Make `out` the folder of a batch, or raise InputError if it holds something else."""
    # Order matters: every run writes this file before all others.
    if list_names(out) and not (out / BATCH).is_file():
        raise InputError(f"{quote_value(out)} holds something other than a batch; name another.")
    write_json(out / BATCH, {"version": 1, "kind": "batch"}, keep_existing=True)


def list_names(folder: Path) -> set[str]:
    """List the names in a folder, without unfinished files; empty if it does not exist."""
    try:
        names = {path.name for path in folder.iterdir()}
    except FileNotFoundError:
        return set()
    except OSError as error:
        raise InputError(
            f"{quote_value(folder)} cannot be read: {error.strerror}; name another."
        ) from error
    return {name for name in names if not name.startswith(UNFINISHED_PREFIX)}


def make_folder(folder: Path) -> None:
    """Create a folder with its parents; raise OutputError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"Cannot write {quote_value(folder)}: {error.strerror}; free some space or choose "
            "another place."
        ) from error


def write_json(path: Path, content: Any, keep_existing: bool = False) -> None:
    """Write JSON atomically; the arguments are those of `replace_file`."""
    make_folder(path.parent)
    with replace_file(path, keep_existing) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())
