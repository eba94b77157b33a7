"""The command `batch`: many completions on several processes and machines.

Workers import this module before they set their number of threads, so it imports no torch.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from gscompleter.apps.batch.manifest import read_manifest
from gscompleter.apps.commands.engines import make_engine, parse_pairs
from gscompleter.apps.commands.options import BatchOptions
from gscompleter.jobs.jobs import (
    JOBS,
    THUMBNAILS,
    Job,
    claim_folder,
    find_missing_jobs,
    list_done_jobs,
    read_row,
    run_claimed,
)
from gscompleter.jobs.places import Place, is_address, open_place
from gscompleter.jobs.workers import parse_shard, run_jobs
from gscompleter.progress import show_preparation, show_progress, track

COUNTERS = Path("/proc/self/io")
"""File in which Linux counts the bytes that this process reads and writes, cached or not."""


def run_batch(options: BatchOptions) -> None:
    """Complete the scenes of a manifest, and write the table and the page."""
    number, count = parse_shard(options.shard, os.environ)
    console = Console(stderr=True, quiet=options.quiet, highlight=False)
    with show_progress(console):
        with show_preparation("reading the manifest"):
            jobs = read_manifest(options.manifest, parse_pairs(options.each, "each"))
            # Absolute, for workers elsewhere.
            out = options.out if is_address(options.out) else os.path.abspath(options.out)
            place = open_place(out)
            engine = make_engine(options, place.name)
            claim_folder(place)
            share = jobs[number::count]
            left = find_missing_jobs(share, place, options.rerun == "failures")
        perform = JobCompleter(out, options.retries)
        ended = run_jobs(
            place, left, perform, lambda: list_done_jobs(place), engine, options.retries
        )
        for _ in track(ended, "completing", len(left)):
            pass
        with show_preparation("table"):
            write_batch_results(place, jobs)
    sentence = f"{summarize_rows(place, share, left)} All results: {options.out}/index.html"
    console.print(sentence, markup=False, soft_wrap=True)


def summarize_rows(place: Place, share: Sequence[Job], left: Sequence[Job]) -> str:
    """Summarize the rows of a share, of which `left` were run now."""
    names = {job.name for job in left}
    rows = [(job.name in names, read_row(place, job.name)) for job in share]
    failed = [is_new for is_new, row in rows if row is not None and row["state"] == "failed"]
    before = f"done earlier {len(share) - len(left)}"
    if not all(failed):
        before += f", {failed.count(False)} of them failed (--rerun failures repeats them)"
    return f"Done {len(left) - sum(failed)}, failed {sum(failed)}, {before}."


def write_batch_results(place: Place, jobs: Sequence[Job]) -> None:
    """Write the table and the page, repeatedly while other shards add rows."""
    from gscompleter.apps.report.batch_page import write_overview

    seen = None
    while seen != (there := list_done_jobs(place)):
        seen = there
        write_overview(place, [job for job in jobs if job.name in there])


@dataclass(frozen=True)
class JobCompleter:
    """A callable that completes the scene of a job, in any process."""

    out: str
    retries: int

    def __call__(self, job: Job) -> None:
        """Complete the scene of `job` and write its row."""
        place = open_place(self.out)
        run_claimed(job, place, lambda: complete_job(job, place), self.retries)


def complete_job(job: Job, place: Place) -> dict[str, Any]:
    """Complete the scene of a job and return its row."""
    import warnings

    from gscompleter.apps.commands.complete import complete_folder
    from gscompleter.apps.commands.row_options import parse_row
    from gscompleter.apps.inputs.fetching import download_inputs
    from gscompleter.apps.report.batch_page import average_scores, make_batch_thumbnail
    from gscompleter.evaluation.memory import measure_peak_memory

    warnings.filterwarnings("ignore", module="PIL")  # as the command line has it
    before = read_counters()
    with measure_peak_memory() as peak:
        with (
            download_inputs(job.options) as given,
            place.open_folder(f"{JOBS}/{job.name}") as folder,
        ):
            summary = complete_folder(parse_row(given, folder))
            thumbnail = make_batch_thumbnail(folder)
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if thumbnail is not None:
            place.write(f"{THUMBNAILS}/{job.name}.jpg", thumbnail)
    costs = {name: count - before[name] for name, count in read_counters().items()}
    return {**average_scores(summary), **costs, "result_bytes": size, "peak_bytes": peak.bytes}


def read_counters() -> dict[str, float]:
    """Read the clocks and the byte counters of this process; 0 if the system has no counters.

    `cpu_seconds` is the sum over all threads, which does not depend on how busy the machine is.
    """
    counters = COUNTERS.read_text() if COUNTERS.is_file() else ""
    found = {name: int(count) for name, count in re.findall(r"^(\w+): (\d+)$", counters, re.M)}
    return {
        "seconds": time.monotonic(),
        "cpu_seconds": time.process_time(),
        "read_bytes": found.get("rchar", 0),
        "written_bytes": found.get("wchar", 0),
    }
