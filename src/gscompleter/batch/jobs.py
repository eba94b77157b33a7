"""A job, what became of it, and the rule by which it is done: once, by whoever claims it first.

    batch.json          what kind of folder this is
    jobs/NAME/          what `complete` wrote
    rows/NAME.json      what became of the job: done or failed, the reason, scores, cost
    thumbnails/NAME.jpg the first target before and after
    claims/NAME         there while somebody does the job, and after somebody was killed over it

A row appears once everything else of its job is there.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from gscompleter.batch.places import Place
from gscompleter.errors import InputError, OutputError, quoted

BATCH = "batch.json"
"""The file that says a folder holds a batch."""
JOBS, ROWS, CLAIMS, THUMBNAILS = "jobs", "rows", "claims", "thumbnails"
"""The folders in it."""
VERSION = 1
"""Of the files in such a folder."""
RETRY_SECONDS = 1.0
"""How long a job waits that failed for no fault of its input, before it is tried again; the second
time twice as long."""
LONGEST_NAME = 120
"""Characters of the name of a job."""


@dataclass(frozen=True)
class Job:
    """Something to do that depends on nothing else."""

    name: str
    """Of its folder and its row; no two jobs of a batch share it."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What it is told."""


State = Literal["done", "failed", "elsewhere", "lost"]
"""What became of a job: a row that is good or says why not; it is being done by somebody else; its
worker was killed over it."""


@dataclass(frozen=True)
class Outcome:
    """What became of a job in one attempt to have it done."""

    job: Job
    state: State
    reason: str | None = None
    """A sentence where it failed."""


Perform = Callable[[Job], Outcome]
"""Does a job in whatever process it is sent to."""


@dataclass(frozen=True)
class Attempts:
    """What came of trying to do a job."""

    result: Mapping[str, Any] | None
    """What the work returned; None where it failed."""
    number: int
    """How often it was begun, in all runs together."""
    reason: str | None = None
    """Why it failed, in one line."""


def settle(job: Job, place: Place, work: Callable[[], Mapping[str, Any]], retries: int) -> Outcome:
    """Claim `job`, do it, and write its row, unless it has one or somebody else does it.

    Args:
        job: What the row is of.
        place: The folder of the batch.
        work: Does it, and returns what the row says besides. It may be called again.
        retries: How often it is tried again after an error that is no InputError, or after the
            process that did it was killed.

    Raises:
        OutputError: where nothing can be written; the job is left for a later run.
    """
    with place.claimed(f"{CLAIMS}/{job.name}") as lost:
        if lost is None:
            return Outcome(job, "elsewhere")
        row = finished_row(place, job)
        if row is None:
            row = row_of(job, attempts(work, lost, retries))
            write_row(place, job.name, row)
        return Outcome(job, row["state"], row["reason"])


def attempts(work: Callable[[], Mapping[str, Any]], lost: int, retries: int) -> Attempts:
    """Do `work` until it comes to an end, `retries` times more at most; `lost` of them are gone.

    Raises:
        OutputError: as `settle`.
    """
    reason = f"its process was killed {lost} times, perhaps for want of memory"
    for number in range(lost + 1, retries + 2):
        try:
            return Attempts(work(), number)
        except OutputError:
            raise
        except InputError as error:
            return Attempts(None, number, str(error))
        except Exception as error:  # a defect of one job must not cost the others
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        if number <= retries:
            time.sleep(RETRY_SECONDS * number)
    return Attempts(None, max(lost, retries + 1), reason)


def row_of(job: Job, attempts: Attempts) -> dict[str, Any]:
    """What became of a job, as its row says it."""
    return {
        "version": VERSION,
        "job": job.name,
        "options": dict(job.options),
        "state": "done" if attempts.reason is None else "failed",
        "reason": attempts.reason,
        "attempts": attempts.number,
        **(attempts.result or {}),
    }


def row_path(name: str) -> str:
    """Where the row of the job of that name lies."""
    return f"{ROWS}/{name}.json"


def write_row(place: Place, name: str, row: Mapping[str, Any]) -> None:
    """Write the row of a job; an OutputError where that cannot be."""
    place.write(row_path(name), (json.dumps(row, indent=1) + "\n").encode())


def read_row(place: Place, name: str) -> dict[str, Any] | None:
    """The row of a job; None where there is none that is whole."""
    content = place.read(row_path(name))
    try:
        row = None if content is None else json.loads(content)
    except ValueError:
        return None
    return row if isinstance(row, dict) and row.get("version") == VERSION else None


def finished_row(place: Place, job: Job) -> dict[str, Any] | None:
    """The row of a job that is done, or failed as it stands in the manifest now."""
    row = read_row(place, job.name)
    if row is None or (row["state"] == "failed" and row["options"] != dict(job.options)):
        return None
    return row


def missing(jobs: Sequence[Job], place: Place, again: bool) -> list[Job]:
    """Those of `jobs` that have no row, or failed and are told something else now.

    Args:
        jobs: Of the manifest.
        place: The folder of the batch.
        again: Whether all that failed are done once more.

    Raises:
        InputError: where one is done with other options.
    """
    there, left = place.names(ROWS), []
    for job in jobs:
        row = read_row(place, job.name) if f"{job.name}.json" in there else None
        if row is not None and row["state"] == "failed" and again:
            place.remove(row_path(job.name))
            row = None
        if row is not None and row["state"] == "done" and row["options"] != dict(job.options):
            raise InputError(
                f"{quoted(place.name)} holds the job {quoted(job.name)} done with other options; "
                "give the row another name, or name another folder."
            )
        if row is None or row["options"] != dict(job.options):
            left.append(job)
    return left


def slug(name: str) -> str:
    """`name` as the name of a file."""
    return re.sub(r"[^\w.+-]+", "-", name).strip(".")[:LONGEST_NAME] or "job"


def claim_folder(place: Place) -> None:
    """Make `place` the folder of a batch, or see that it is.

    Raises:
        InputError: where it holds something else.
        OutputError: where nothing can be written there.
    """
    content = json.dumps({"version": VERSION, "kind": "batch"}).encode() + b"\n"
    # In this order: another run that has written anything there has written that file before.
    others = place.names("")
    if others and place.read(BATCH) is None:
        raise InputError(f"{quoted(place.name)} holds something other than a batch; name another.")
    if place.read(BATCH) is None:
        place.write(BATCH, content)
    if place.read(BATCH) != content:
        raise InputError(
            f"{quoted(place.name)} holds a batch of another version; name another folder."
        )


def check_jobs(jobs: Sequence[Job]) -> None:
    """Raise an InputError for no job at all, and for two of one name."""
    if not jobs:
        raise InputError("The manifest names no job; give it a row for each scene.")
    seen: set[str] = set()
    for job in jobs:
        if job.name in seen:
            raise InputError(
                f"Two jobs have the name {quoted(job.name)}; give each row a name of its own."
            )
        seen.add(job.name)
