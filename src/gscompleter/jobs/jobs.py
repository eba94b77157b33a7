"""Jobs, their rows, and how each is run once, by the first process that claims it.

batch.json          kind and version of the folder
jobs/NAME/          output of `complete`
rows/NAME.json      outcome of the job: state, reason, scores, cost; written last
thumbnails/NAME.jpg first target before and after completion
claims/NAME         exists while a process runs the job, or after one was killed by it
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gscompleter.errors import InputError, OutputError, quote_value
from gscompleter.jobs.places import Place

BATCH = "batch.json"
"""Name of the file that marks the folder of a batch."""
JOBS, ROWS, CLAIMS, THUMBNAILS = "jobs", "rows", "claims", "thumbnails"
"""Folders of a batch."""
VERSION = 1
"""Version of the files of a batch."""
RETRY_SECONDS = 1.0
"""Delay before the first retry after an error not caused by the input; doubled for the next."""
LONGEST_NAME = 120
"""Maximum number of characters of a job name."""

Row = dict[str, Any]
"""Outcome of a job: its state is `done` or `failed`."""


@dataclass(frozen=True)
class Job:
    """A piece of work that does not depend on others."""

    name: str
    """Unique name, of its folder and its row."""
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def claim(self) -> str:
        """Path of its claim."""
        return f"{CLAIMS}/{self.name}"

    @property
    def row(self) -> str:
        """Path of its row."""
        return f"{ROWS}/{self.name}.json"


def run_claimed(
    job: Job, place: Place, work: Callable[[], Mapping[str, Any]], retries: int
) -> None:
    """Claim a job, run it and write its row, unless it has a row or another process runs it.

    `work` returns further entries of the row. It is repeated after a killed process or any error
    other than InputError, at most `retries` times.
    """
    if read_row(place, job.name) is not None:
        return
    with place.hold_claim(job.claim) as lost:
        if lost is not None and read_row(place, job.name) is None:
            row = {"version": VERSION, "job": job.name, "options": dict(job.options)}
            row |= run_with_retries(work, lost, retries)
            place.write(job.row, (json.dumps(row, indent=1) + "\n").encode())


def run_with_retries(work: Callable[[], Mapping[str, Any]], lost: int, retries: int) -> Row:
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
    """Describe why a job whose processes were killed has no result."""
    return f"its process was killed {lost} times, perhaps because memory ran out"


def read_row(place: Place, name: str) -> Row | None:
    """Read the row of a job, or return None if there is no complete one."""
    content = place.read(Job(name).row)
    try:
        row = None if content is None else json.loads(content)
    except ValueError:
        return None
    return row if isinstance(row, dict) and row.get("version") == VERSION else None


def find_missing_jobs(jobs: Sequence[Job], place: Place, rerun_failed: bool) -> list[Job]:
    """Return jobs without a row, and remove the failed rows to repeat (new options, or `rerun`).

    Raises:
        InputError: A job was done with other options.
    """
    existing, left = place.list_names(ROWS), []
    for job in jobs:
        is_there = f"{job.name}.json" in existing
        row = read_row(place, job.name) if is_there else None
        is_other = row is not None and row["options"] != dict(job.options)
        if row is not None and row["state"] == "done" and is_other:
            raise InputError(
                f"{quote_value(place.name)} holds the job {quote_value(job.name)} done with other "
                "options; give the row another name, or name another folder."
            )
        if row is None or (row["state"] == "failed" and (rerun_failed or is_other)):
            left.append(job)
            if is_there:
                place.remove(job.row)
    return left


def list_done_jobs(place: Place) -> set[str]:
    """List the names of the jobs with a row."""
    return {name.removesuffix(".json") for name in place.list_names(ROWS)}


def make_job_name(name: str) -> str:
    """Turn a name into a valid file name."""
    return re.sub(r"[^\w.+-]+", "-", name).strip(".")[:LONGEST_NAME] or "job"


def claim_folder(place: Place) -> None:
    """Make `place` the folder of a batch, or raise InputError if it holds something else."""
    content = json.dumps({"version": VERSION, "kind": "batch"}).encode() + b"\n"
    # Order matters: every run writes this file before all others.
    others = place.list_names("")
    if others and place.read(BATCH) is None:
        raise InputError(
            f"{quote_value(place.name)} holds something other than a batch; name another."
        )
    if place.read(BATCH) is None:
        place.write(BATCH, content)
    if place.read(BATCH) != content:
        raise InputError(
            f"{quote_value(place.name)} holds a batch of another version; name another folder."
        )


def check_jobs(jobs: Sequence[Job]) -> None:
    """Raise InputError if there is no job, or if two have the same name."""
    if not jobs:
        raise InputError("The manifest names no job; give it a row for each scene.")
    seen: set[str] = set()
    for job in jobs:
        if job.name in seen:
            raise InputError(
                f"Two jobs have the name {quote_value(job.name)}; give each row a name of its own."
            )
        seen.add(job.name)
