"""Jobs, their outcomes, and how each is run once, by the first process that claims it.

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
from typing import Any, Literal

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


@dataclass(frozen=True)
class Job:
    """A piece of work that does not depend on others."""

    name: str
    """Unique name, of its folder and its row."""
    options: Mapping[str, Any] = field(default_factory=dict)


State = Literal["done", "failed", "elsewhere", "lost"]
"""Outcome of a job: row written (done, failed), run by another process, or worker killed."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one attempt to run a job."""

    job: Job
    state: State
    reason: str | None = None
    """One sentence if the job failed."""


Perform = Callable[[Job], Outcome]
"""Runs a job, in any process."""


@dataclass(frozen=True)
class Attempts:
    """Result of the attempts at a job."""

    result: Mapping[str, Any] | None
    """Return value of the work, or None if it failed."""
    number: int
    """Number of attempts in all runs together."""
    reason: str | None = None


def run_claimed(
    job: Job, place: Place, work: Callable[[], Mapping[str, Any]], retries: int
) -> Outcome:
    """Claim a job, run it and write its row, unless it has a row or another process runs it.

    `work` returns further entries of the row. It is repeated after a killed process or any error
    other than InputError, at most `retries` times.
    """
    with place.hold_claim(f"{CLAIMS}/{job.name}") as lost:
        if lost is None:
            return Outcome(job, "elsewhere")
        row = read_finished_row(place, job)
        if row is None:
            row = make_job_row(job, run_with_retries(work, lost, retries))
            write_row(place, job.name, row)
        return Outcome(job, row["state"], row["reason"])


def run_with_retries(work: Callable[[], Mapping[str, Any]], lost: int, retries: int) -> Attempts:
    """Run `work` with retries; `lost` attempts have already been killed."""
    reason = f"its process was killed {lost} times, perhaps because memory ran out"
    for number in range(lost + 1, retries + 2):
        try:
            return Attempts(work(), number)
        except OutputError:
            raise
        except InputError as error:
            return Attempts(None, number, str(error))
        except Exception as error:  # one broken job must not stop the others
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        if number <= retries:
            time.sleep(RETRY_SECONDS * number)
    return Attempts(None, max(lost, retries + 1), reason)


def make_job_row(job: Job, attempts: Attempts) -> dict[str, Any]:
    """Build the row of a job."""
    return {
        "version": VERSION,
        "job": job.name,
        "options": dict(job.options),
        "state": "done" if attempts.reason is None else "failed",
        "reason": attempts.reason,
        "attempts": attempts.number,
        **(attempts.result or {}),
    }


def get_job_row_path(name: str) -> str:
    """Return the path of the row of a job."""
    return f"{ROWS}/{name}.json"


def write_row(place: Place, name: str, row: Mapping[str, Any]) -> None:
    """Write the row of a job; raise OutputError if that fails."""
    place.write(get_job_row_path(name), (json.dumps(row, indent=1) + "\n").encode())


def read_row(place: Place, name: str) -> dict[str, Any] | None:
    """Read the row of a job, or return None if there is no complete one."""
    content = place.read(get_job_row_path(name))
    try:
        row = None if content is None else json.loads(content)
    except ValueError:
        return None
    return row if isinstance(row, dict) and row.get("version") == VERSION else None


def read_finished_row(place: Place, job: Job) -> dict[str, Any] | None:
    """Read the row of a job that is done, or failed with the same options as now."""
    row = read_row(place, job.name)
    if row is None or (row["state"] == "failed" and row["options"] != dict(job.options)):
        return None
    return row


def find_missing_jobs(jobs: Sequence[Job], place: Place, rerun_failed: bool) -> list[Job]:
    """Return jobs without a row or with a failed one to repeat (new options, or `rerun`).

    Raises:
        InputError: A job was done with other options.
    """
    existing, left = place.list_names(ROWS), []
    for job in jobs:
        row = read_row(place, job.name) if f"{job.name}.json" in existing else None
        if row is not None and row["state"] == "failed" and rerun_failed:
            place.remove(get_job_row_path(job.name))
            row = None
        if row is not None and row["state"] == "done" and row["options"] != dict(job.options):
            raise InputError(
                f"{quote_value(place.name)} holds the job {quote_value(job.name)} done with other "
                "options; "
                "give the row another name, or name another folder."
            )
        if row is None or row["options"] != dict(job.options):
            left.append(job)
    return left


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
