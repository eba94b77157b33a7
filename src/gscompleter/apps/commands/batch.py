"""The command `batch`: many completions on several processes and machines.

Workers import this module before they set their number of threads, so it imports no torch.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from gscompleter.apps.batch.manifest import read_manifest
from gscompleter.apps.commands.engines import make_engine, parse_pairs
from gscompleter.apps.commands.options import BatchOptions
from gscompleter.errors import InputError, quote_value
from gscompleter.jobs.jobs import (
    JOBS,
    Job,
    claim_folder,
    find_missing_jobs,
    has_row,
    make_folder,
    parse_shard,
    read_row,
    run_job,
    run_jobs,
)
from gscompleter.progress import show_preparation, show_progress, track


def run_batch(options: BatchOptions) -> None:
    """Complete the scenes of a manifest, and write the table and the page."""
    if re.match(r"\w\w+:/", str(options.out)):
        raise InputError(f"{quote_value(options.out)} is an address; name a folder.", "out")
    number, count = parse_shard(options.shard, os.environ)
    console = Console(stderr=True, quiet=options.quiet, highlight=False)
    with show_progress(console):
        with show_preparation("reading the manifest"):
            jobs = read_manifest(options.manifest, parse_pairs(options.each, "each"))
            out = options.out.resolve()  # absolute, for workers elsewhere
            engine = make_engine(options, out)
            claim_folder(out, "batch", {"version": 1, "kind": "batch"})
            share = jobs[number::count]
            left = find_missing_jobs(share, out, options.rerun == "failures")
        perform = partial(perform_job, out=out, retries=options.retries)
        ended = run_jobs(left, perform, partial(has_row, out=out), engine, options.retries)
        for _ in track(ended, "completing", len(left)):
            pass
        with show_preparation("table"):
            write_batch_results(out, jobs)
    sentence = f"{summarize_rows(out, share, left)} All results: {options.out}/index.html"
    console.print(sentence, markup=False, soft_wrap=True)


def summarize_rows(out: Path, share: Sequence[Job], left: Sequence[Job]) -> str:
    """Summarize the rows of a share, of which `left` were run now."""
    names = {job.name for job in left}
    rows = [(job.name in names, read_row(job, out)) for job in share]
    failed = [is_new for is_new, row in rows if row is not None and row["state"] == "failed"]
    before = f"done earlier {len(share) - len(left)}"
    if not all(failed):
        before += f", {failed.count(False)} of them failed (--rerun failures repeats them)"
    return f"Done {len(left) - sum(failed)}, failed {sum(failed)}, {before}."


def write_batch_results(out: Path, jobs: Sequence[Job]) -> None:
    """Write the table and the page, repeatedly while other shards add rows."""
    from gscompleter.apps.report.batch_page import write_overview

    seen = None
    while seen != (there := [job for job in jobs if has_row(job, out)]):
        seen = there
        write_overview(out, there)


def perform_job(job: Job, out: Path, retries: int) -> None:
    """Complete the scene of a job in any process, and write its row."""
    run_job(job, out, lambda: complete_job(job, out / JOBS), retries)


def complete_job(job: Job, jobs: Path) -> dict[str, Any]:
    """Complete the scene of a job in a folder of `jobs`, and return its part of a row.

    `cpu_seconds` is the sum over all threads, which does not depend on how busy the machine is.
    """
    import warnings

    from gscompleter.apps.commands.complete import complete_folder
    from gscompleter.apps.commands.row_options import parse_row
    from gscompleter.apps.report.batch_page import average_scores
    from gscompleter.evaluation.memory import measure_peak_memory

    warnings.filterwarnings("ignore", module="PIL")  # as the command line has it
    start, cpu_start = time.monotonic(), time.process_time()
    make_folder(jobs)
    with measure_peak_memory() as peak:
        summary = complete_folder(parse_row(job.options, jobs / job.name))
    return {
        **average_scores(summary),
        "seconds": time.monotonic() - start,
        "cpu_seconds": time.process_time() - cpu_start,
        "result_bytes": sum(f.stat().st_size for f in (jobs / job.name).rglob("*") if f.is_file()),
        "peak_bytes": peak.bytes,
    }
