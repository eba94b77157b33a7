"""Completion of the scenes of a manifest, on several processes and machines.

Workers import this module before they set their number of threads, so it imports no torch.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from gscompleter.apps.batch.engine import make_engine
from gscompleter.apps.batch.manifest import PATH_COLUMNS, list_results, read_manifest
from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.command_line.exit_codes import choose_exit_code
from gscompleter.apps.requests.batch import BatchRequest
from gscompleter.apps.requests.completion import FillingRequest
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, join_names, print_error
from gscompleter.system.files.overlap import refuse_overlap
from gscompleter.system.jobs.claims import claim_share
from gscompleter.system.jobs.jobs import (
    JOBS,
    Engine,
    Job,
    claim_folder,
    find_missing_jobs,
    has_row,
    make_folder,
    read_row,
    run_job,
    run_jobs,
)
from gscompleter.system.progress import show_preparation, show_progress, track

DecideRow = Callable[[Mapping[str, Any], Path], FillingRequest]
"""Makes the request of the options of a row of a manifest, for an output folder."""

OUTCOMES = {"nothing-gained": "nothing gained"}
"""Words for the outcomes of jobs that did not fail; any other is "completed"."""
MAX_NAMED_FAILURES = 5
"""Most failures that the terminal names, and most folders of earlier results."""


@dataclass(frozen=True)
class PreparedBatch:
    """A manifest that was read, and the jobs of it that this process has to do."""

    out: Path
    """Absolute output folder: workers may run in another working folder."""
    engine: Engine | None
    """Runs the jobs; None for this process."""
    jobs: Sequence[Job]
    """A job for each row."""
    share: Sequence[Job]
    """Those of this process; all without `--shard`."""


def complete_batch(request: BatchRequest, decide_row: DecideRow) -> int:
    """Complete the scenes of a manifest, write the table and the page, and return the exit code.

    `decide_row` makes the request of a row in the process of a worker, which imports it by name.
    """
    console = make_console(stderr=True, quiet=request.answer.quiet)
    with show_progress(console):
        with show_preparation("reading the manifest"):
            batch = prepare_batch(request)

        # A folder of scenes can hold the results of earlier runs, which are no input.
        if results := list_results(request.manifest, request.out):
            names = join_names([path.name for path in results], MAX_NAMED_FAILURES)
            console.print(f"Left out, as results and no scenes: {names}.", soft_wrap=True)

        with claim_share(batch.out, request.engine.share):
            left = find_missing_jobs(batch.share, batch.out, request.repeats_failures)
            run_jobs_left(batch, left, request.retries, decide_row, console)
        with show_preparation("table"):
            write_batch_results(batch.out, batch.jobs)

    # The exit code and the sentence count this share, with the jobs that failed in earlier runs.
    rows = [row for job in batch.share if (row := read_row(job, batch.out)) is not None]
    failed = [row for row in rows if row["state"] == "failed"]
    print_failures(console, [f"{row['job']}: {row['reason']}" for row in failed], len(batch.share))
    summary = summarize_share({row["job"] for row in failed}, batch.share, left)
    console.print(f"{summary} All results: {request.out}/index.html", soft_wrap=True)
    if request.answer.json:
        print_json({"out": str(request.out), "failed": len(failed), "rows": rows})
    return choose_exit_code(len(failed), len(batch.share))


def prepare_batch(request: BatchRequest) -> PreparedBatch:
    """Read the manifest, and claim the output folder for results of this kind."""
    share_number, num_shares = request.engine.share
    jobs = read_manifest(request.manifest, request.common, request.out)
    refuse_overlap(request.out, list_input_paths(jobs))

    out = request.out.resolve()
    engine = make_engine(request.engine, out)
    claim_folder(out, "batch", {"version": 1, "kind": "batch"})

    return PreparedBatch(out=out, engine=engine, jobs=jobs, share=jobs[share_number::num_shares])


def run_jobs_left(
    batch: PreparedBatch,
    left: Sequence[Job],
    retries: int,
    decide_row: DecideRow,
    console: Console,
) -> None:
    """Run the jobs of a batch that are left, and print a line as each of them ends.

    A job is tried `retries` times more if its process was killed or it failed unexpectedly.
    """
    out = batch.out
    perform = partial(perform_job, out=out, retries=retries, decide_row=decide_row)
    ended = run_jobs(left, perform, partial(has_row, out=out), batch.engine, retries)
    total = len(left)
    for number, job in enumerate(track(ended, "completing", total, has_lines=False), start=1):
        state = describe_state(read_row(job, out))
        console.print(f"{number} of {total}: {job.name}, {state}", soft_wrap=True)


def list_input_paths(jobs: Sequence[Job]) -> list[Path]:
    """List the paths of `PATH_COLUMNS` in the rows of a manifest, each once."""
    cells = [job.options.get(name) for job in jobs for name in PATH_COLUMNS]
    # A row whose path is no text, as JSON allows, fails by itself.
    paths = dict.fromkeys(cell for cell in cells if isinstance(cell, str) and cell)
    return [Path(path) for path in paths]


def describe_state(row: Mapping[str, Any] | None) -> str:
    """Describe in a word or two how the job of a row ended; None is no row."""
    if row is None:
        return "not known"
    if row["state"] == "failed":
        return "failed"
    return OUTCOMES.get(str(row.get("outcome")), "completed")


def print_failures(console: Console, failures: Sequence[str], num_cases: int) -> None:
    """Print the first failures of jobs or cases, and the number of the others.

    `failures` are sentences with names and reasons. A quiet console gets one line: an exit code
    other than 0 is never without a reason.
    """
    if failures and console.quiet:
        counted = f"{len(failures)} of {num_cases} cases failed"
        print_error(f"{counted}; the first: {failures[0]}")
    for failure in failures[:MAX_NAMED_FAILURES]:
        console.print(f"Failed: {failure}", soft_wrap=True)
    if len(failures) > MAX_NAMED_FAILURES:
        console.print(f"... and {len(failures) - MAX_NAMED_FAILURES} more failed.")


def summarize_share(failed: set[str], share: Sequence[Job], left: Sequence[Job]) -> str:
    """Summarize the jobs of a share, of which `left` were run now; `failed` are names."""
    failed_now = len(failed & {job.name for job in left})
    failed_earlier = len(failed) - failed_now
    before = f"done earlier {len(share) - len(left)}"
    if failed_earlier:
        before += f", {failed_earlier} of them failed (--rerun failures repeats them)"
    return f"Done {len(left) - failed_now}, failed {failed_now}, {before}."


def write_batch_results(out: Path, jobs: Sequence[Job]) -> None:
    """Write the table and the page, again until no other shard has added a row meanwhile."""
    from gscompleter.apps.report.page import write_overview

    # A shard that ends while this one writes may be overwritten by an older table. Whoever writes
    # last looks once more, and so the table that remains has all rows.
    written: list[Job] | None = None
    finished = [job for job in jobs if has_row(job, out)]
    while finished != written:
        write_overview(out, finished)
        written = finished
        finished = [job for job in jobs if has_row(job, out)]


def perform_job(job: Job, out: Path, retries: int, decide_row: DecideRow) -> None:
    """Complete the scene of a job and write its row, in this process or in a worker."""
    run_job(job, out, lambda: complete_job(job, out / JOBS, decide_row), retries)


def complete_job(job: Job, jobs: Path, decide_row: DecideRow) -> dict[str, Any]:
    """Complete the scene of a job in its folder below `jobs`, and return its part of a row.

    That has the outcome, the scores and what it cost: seconds of wall time, seconds of CPU time of
    this process (without that of COLMAP, which has its own), bytes of files, and the peak
    of the resident memory of this process, None where the system does not tell it.
    """
    import warnings

    from gscompleter.apps.completing.complete import complete_folder
    from gscompleter.apps.report.page import average_scores
    from gscompleter.evaluation.memory import measure_peak_memory

    # A worker does not run `cli.main`, which sets this filter for the other commands.
    warnings.filterwarnings("ignore", module="PIL")
    start = time.monotonic()
    cpu_start = time.process_time()
    make_folder(jobs)
    with measure_peak_memory() as peak:
        # The batch gives each job to one worker, and to a further one only if that is lost, whose
        # reservation of the folder is then void.
        summary = complete_folder(decide_row(job.options, jobs / job.name), takes_over=True)

    # A scene that did not reconstruct counts as failed. Its folder stays, to look at.
    outcome = summary["outcome"]
    if outcome["status"] == "not-reconstructed":
        raise InputError(outcome["headline"])

    files = [path for path in (jobs / job.name).rglob("*") if path.is_file()]
    return {
        "outcome": outcome["status"],
        "headline": outcome["headline"],
        **average_scores(summary),
        "seconds": time.monotonic() - start,
        "cpu_seconds": time.process_time() - cpu_start,
        "result_bytes": sum(path.stat().st_size for path in files),
        "peak_bytes": peak.bytes,
    }
