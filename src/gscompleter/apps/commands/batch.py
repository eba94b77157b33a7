"""The command `batch`: many completions on several processes and machines.

Workers import this module before they set their number of threads, so it imports no torch.
"""

from __future__ import annotations

import os
import re
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

from rich.console import Console

from gscompleter.apps.batch.manifest import FOLDER, PATHS, list_results, read_manifest
from gscompleter.apps.commands.exit_codes import choose_exit_code
from gscompleter.apps.commands.options import (
    BatchOptions,
    CompleteOptions,
    EngineOptions,
)
from gscompleter.apps.commands.words import format_error, parse_words
from gscompleter.config.settings import validate
from gscompleter.system.errors import InputError, join_names, print_error, quote_value
from gscompleter.system.files.overlap import refuse_overlap
from gscompleter.system.jobs.engines import (
    check_processes,
    choose_num_workers,
    open_local,
    open_ray,
    open_submitit,
)
from gscompleter.system.jobs.jobs import (
    JOBS,
    Engine,
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
from gscompleter.system.progress import show_preparation, show_progress, track
from gscompleter.system.threads import count_available_cores, limit_threads

COMPLETE = "complete"
RESERVED = ("out", "overwrite", "quiet", "threads", "dry-run", "help", "help-all")
"""Options that a batch sets for all jobs."""
MAX_NAMED_FAILURES = 5
"""Most failures that the terminal names."""
TRUE = ("true", "yes", "1")
"""Values of a CSV that set a flag."""
FALSE = ("false", "no", "0", "")
"""Values of a CSV that leave a flag unset; an empty cell is one of them."""


def run_batch(options: BatchOptions) -> int:
    """Complete the scenes of a manifest, write the table and the page, and return the exit code."""
    # Two letters at least: `C:/results` is a path of Windows.
    if re.match(r"\w\w+:/", str(options.out)):
        raise InputError(f"{quote_value(options.out)} is an address; name a folder.", "out")
    number, count = parse_shard(options.shard, os.environ)
    console = Console(stderr=True, quiet=options.quiet, highlight=False)
    with show_progress(console):
        with show_preparation("reading the manifest"):
            common = parse_pairs(options.each, "each")
            jobs = read_manifest(options.manifest, common, options.out)

            # The results may not lie in what the rows read.
            # A row whose path is no text, as JSON allows, fails by itself.
            cells = [job.options.get(name) for job in jobs for name in PATHS]
            paths = dict.fromkeys(cell for cell in cells if isinstance(cell, str) and cell)
            inputs = [Path(path) for path in paths]
            refuse_overlap(options.out, inputs)

            # Workers may run in another working folder, so they get an absolute path.
            out = options.out.resolve()
            engine = make_engine(options, out)
            claim_folder(out, "batch", {"version": 1, "kind": "batch"})

            share = jobs[number::count]
            left = find_missing_jobs(share, out, options.rerun == "failures")

        # A folder of scenes can hold the results of earlier runs, which are no input.
        if results := list_results(options.manifest, options.out):
            names = join_names([path.name for path in results], MAX_NAMED_FAILURES)
            console.print(f"Left out, as results and no scenes: {names}.", markup=False)

        perform = partial(perform_job, out=out, retries=options.retries)
        ended = run_jobs(left, perform, partial(has_row, out=out), engine, options.retries)
        for _ in track(ended, "completing", len(left)):
            pass
        with show_preparation("table"):
            write_batch_results(out, jobs)

    # The exit code and the sentence count this share, with the jobs that failed in earlier runs.
    failures = []
    for job in share:
        row = read_row(job, out)
        if row is not None and row["state"] == "failed":
            failures.append(f"{row['job']}: {row['reason']}")
    print_failures(console, failures, len(share))
    sentence = f"{summarize_rows(out, share, left)} All results: {options.out}/index.html"
    console.print(sentence, markup=False, soft_wrap=True)
    return choose_exit_code(len(failures), len(share))


def print_failures(console: Console, failures: Sequence[str], num_cases: int) -> None:
    """Print the first failures with their reasons, and the number of the others.

    A quiet console gets one line: an exit code other than 0 is never without a reason.
    """
    if failures and console.quiet:
        counted = f"{len(failures)} of {num_cases} cases failed"
        print_error(f"{counted}; the first: {failures[0]}")
    for failure in failures[:MAX_NAMED_FAILURES]:
        console.print(f"Failed: {failure}", markup=False, soft_wrap=True)
    if len(failures) > MAX_NAMED_FAILURES:
        console.print(f"... and {len(failures) - MAX_NAMED_FAILURES} more failed.")


def summarize_rows(out: Path, share: Sequence[Job], left: Sequence[Job]) -> str:
    """Summarize the rows of a share, of which `left` were run now."""
    names_left = {job.name for job in left}
    failed_now = 0
    failed_earlier = 0
    for job in share:
        row = read_row(job, out)
        if row is None or row["state"] != "failed":
            continue
        if job.name in names_left:
            failed_now += 1
        else:
            failed_earlier += 1

    before = f"done earlier {len(share) - len(left)}"
    if failed_earlier:
        before += f", {failed_earlier} of them failed (--rerun failures repeats them)"
    return f"Done {len(left) - failed_now}, failed {failed_now}, {before}."


def write_batch_results(out: Path, jobs: Sequence[Job]) -> None:
    """Write the table and the page, repeatedly while other shards add rows."""
    from gscompleter.apps.report.page import write_overview

    # A shard that ends while this one writes may be overwritten by an older table. Whoever writes
    # last looks once more, and so the table that remains has all rows.
    written: list[Job] | None = None
    finished = [job for job in jobs if has_row(job, out)]
    while finished != written:
        write_overview(out, finished)
        written = finished
        finished = [job for job in jobs if has_row(job, out)]


def perform_job(job: Job, out: Path, retries: int) -> None:
    """Complete the scene of a job in any process, and write its row."""
    run_job(job, out, lambda: complete_job(job, out / JOBS), retries)


def complete_job(job: Job, jobs: Path) -> dict[str, Any]:
    """Complete the scene of a job in a folder of `jobs`, and return its part of a row."""
    import warnings

    from gscompleter.apps.commands.complete import complete_folder
    from gscompleter.apps.report.page import average_scores
    from gscompleter.evaluation.memory import measure_peak_memory

    # A worker does not run `cli.main`, which sets this filter for the other commands.
    warnings.filterwarnings("ignore", module="PIL")
    start = time.monotonic()
    cpu_start = time.process_time()
    make_folder(jobs)
    with measure_peak_memory() as peak:
        # The batch gives each job to one worker, and a further one only if that is lost.
        summary = complete_folder(parse_row(job.options, jobs / job.name), takes_over=True)

    # A scene that did not reconstruct counts as failed. Its folder stays, to look at.
    outcome = summary["outcome"]
    if outcome["status"] == "not-reconstructed":
        raise InputError(outcome["headline"])

    files = [path for path in (jobs / job.name).rglob("*") if path.is_file()]
    return {
        **average_scores(summary),
        "seconds": time.monotonic() - start,
        "cpu_seconds": time.process_time() - cpu_start,
        "result_bytes": sum(path.stat().st_size for path in files),
        "peak_bytes": peak.bytes,
    }


def parse_row(row: Mapping[str, Any], out: Path) -> CompleteOptions:
    """Parse a row, or raise InputError; `out` is the output folder."""
    if not isinstance(row.get(FOLDER), str):
        raise InputError("The row has no folder; give it the folder of a scene.")
    # The row becomes a command line, so that its values are read and refused as those of
    # `complete`. Overwriting is safe: the folder of a job is in the batch's own output.
    words = [COMPLETE, row[FOLDER], *row_to_words(row), "--out", str(out), "--overwrite", "--quiet"]
    try:
        options: CompleteOptions = validate(parse_words(words, {COMPLETE: CompleteOptions}))
    except InputError as error:
        # Only the sentence is kept in the row of a failed job, so it names the option itself.
        raise InputError(format_error(error)) from error
    return options


def row_to_words(row: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Convert a row to words of a command line; nested mappings give `--config.holes.dilation`."""
    for key, value in row.items():
        name = f"{prefix}{key}".replace("_", "-")
        if name in RESERVED:
            raise InputError(f"A row cannot set '{quote_value(name)}'; the batch sets it.")
        if isinstance(value, Mapping):
            yield from row_to_words(value, f"{name}.")
        elif name != FOLDER and value is not None:
            yield from option_to_words(name, value)


def option_to_words(name: str, value: Any) -> list[str]:
    """Convert an option to words; a text is split like a shell if it can have several values."""
    kind = get_type_hints(CompleteOptions).get(name.replace("-", "_"))

    # A flag has no value on the command line: it is there or not.
    if kind is bool:
        if str(value).lower() not in TRUE + FALSE:
            raise InputError(f"{name} is {quote_value(str(value))}; it must be true or false.")
        return [f"--{name}"] if str(value).lower() in TRUE else []

    # A CSV has one text for `0 4`, where JSON has a list. Only options with several values are
    # split, because a single path may contain spaces.
    values = value if isinstance(value, list) else [value]
    if isinstance(value, str) and "tuple" in str(kind).lower():
        try:
            values = shlex.split(value)
        except ValueError as error:
            raise InputError(f"'{quote_value(value)}' has an unmatched quotation mark.") from error

    # The parser would take a value such as `--out` for an option; negative numbers are none.
    words = [str(item) for item in values]
    for word in words:
        if re.match(r"-(?![\d.])", word):
            raise InputError(f"{name} cannot be '{quote_value(word)}', which begins with a dash.")
    return [f"--{name}", *words]


def parse_pairs(words: Sequence[str], option: str) -> dict[str, str]:
    """Parse `NAME=VALUE` words."""
    pairs = {}
    for word in words:
        name, sign, value = word.partition("=")
        if not name or not sign:
            raise InputError(
                f"'{quote_value(word)}' is not NAME=VALUE, as in resolution=256.", option
            )
        pairs[name] = value
    return pairs


def make_engine(options: EngineOptions, out: Path) -> Engine | None:
    """Create the engine, or None for this process.

    On this machine it also sets the threads, which workers inherit.
    """
    if options.engine is None:
        return None

    # Cores of machines elsewhere are not known here, so their workers get one thread by default.
    threads = options.threads or 1
    if options.engine == "ray":
        return partial(open_ray, options.workers, threads, options.gpus, options.address)
    if options.engine == "submitit":
        slurm = parse_pairs(options.slurm, "slurm")
        workers = options.workers or 1
        return partial(open_submitit, workers, threads, options.gpus, out / "submitit", slurm)

    # Workers on this machine share its cores. With torch's default each would take all of them.
    check_processes()
    workers = options.workers or choose_num_workers()
    limit_threads(options.threads or max(1, count_available_cores() // workers))
    return partial(open_local, workers)
