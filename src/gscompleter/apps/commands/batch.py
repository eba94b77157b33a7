"""The command `batch`: many completions on several processes and machines."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gscompleter.apps.commands.options import BatchOptions

if TYPE_CHECKING:
    from gscompleter.jobs.jobs import Job, Outcome
    from gscompleter.jobs.places import Place


@dataclass(frozen=True)
class Counts:
    """Numbers of jobs of one call."""

    done: int
    failed: int
    skipped: int
    skipped_failed: int = 0
    """Skipped jobs whose row records a failure."""

    def summarize(self) -> str:
        """Summarize the counts, and name the option that retries earlier failures."""
        before = f"done earlier {self.skipped}"
        if self.skipped_failed:
            before += f", {self.skipped_failed} of them failed (--rerun failures repeats them)"
        return f"Done {self.done}, failed {self.failed}, {before}."


def run_batch(options: BatchOptions) -> None:
    """Complete the scenes of a manifest, and write the table and the page."""
    # Imported here so that `--help` does not wait for torch.
    from rich.console import Console

    from gscompleter.apps.batch.manifest import read_manifest
    from gscompleter.apps.commands.engines import make_engine, parse_pairs
    from gscompleter.jobs.jobs import claim_folder, find_missing_jobs
    from gscompleter.jobs.places import open_place
    from gscompleter.jobs.rounds import BatchRows, Rounds
    from gscompleter.jobs.shards import parse_shard
    from gscompleter.progress import show_preparation, show_progress

    number, count = parse_shard(options.shard, os.environ)
    console = Console(stderr=True, quiet=options.quiet, highlight=False)
    with show_progress(None if options.quiet else console):
        with show_preparation("reading the manifest"):
            jobs = read_manifest(options.manifest, parse_pairs(options.each, "each"))
            place = open_place(make_absolute(options.out))
            engine = make_engine(options, place.name)
            claim_folder(place)
            share = jobs[number::count]
            left = find_missing_jobs(share, place, options.rerun == "failures")
            names = {job.name for job in left}
            failed_before = count_failed(place, [job for job in share if job.name not in names])
        rounds = Rounds(place, BatchRows(place), left, options.retries)
        perform = JobCompleter(make_absolute(options.out), options.retries)
        failed = sum(
            outcome.state == "failed"
            for outcome in show_outcomes(rounds.run(engine, perform), len(left))
        )
        with show_preparation("table"):
            write_batch_results(place, jobs)
    counts = Counts(len(left) - failed, failed, len(share) - len(left), failed_before)
    sentence = f"{counts.summarize()} All results: {options.out}/index.html"
    console.print(sentence, markup=False, soft_wrap=True)


def count_failed(place: Place, jobs: Iterable[Job]) -> int:
    """Count the jobs whose row records a failure."""
    from gscompleter.jobs.jobs import read_row

    rows = (read_row(place, job.name) for job in jobs)
    return sum(row is not None and row["state"] == "failed" for row in rows)


def make_absolute(out: str) -> str:
    """Make a path absolute for workers elsewhere; addresses stay as they are."""
    return out if "://" in out else os.path.abspath(out)


def show_outcomes(outcomes: Iterable[Outcome], total: int) -> Iterator[Outcome]:
    """Show the progress and the rate while iterating over outcomes."""
    from gscompleter.progress import Activity, show_activity

    if not total:
        return
    activity = Activity("completing", total)
    with show_activity(activity):
        for outcome in outcomes:
            yield outcome
            activity.count_step()
            minutes = (activity.last_step_time - activity.start_time) / 60
            activity.name = f"completing ({activity.num_done / minutes:.1f} a minute)"


def write_batch_results(place: Place, jobs: Sequence[Job]) -> None:
    """Write the table and the page, repeatedly while other shards add rows."""
    from gscompleter.apps.report.batch_page import write_overview
    from gscompleter.jobs.jobs import ROWS

    seen = None
    while seen != (there := place.list_names(ROWS)):
        seen = there
        write_overview(place, [job for job in jobs if f"{job.name}.json" in there])


@dataclass(frozen=True)
class JobCompleter:
    """A callable that completes the scene of a job, in any process."""

    out: str
    retries: int

    def __call__(self, job: Job) -> Outcome:
        """Complete the scene of `job`."""
        from gscompleter.jobs.jobs import run_claimed
        from gscompleter.jobs.places import open_place

        place = open_place(self.out)
        return run_claimed(job, place, lambda: complete_job(job, place), self.retries)


def complete_job(job: Job, place: Place) -> dict[str, Any]:
    """Complete the scene of a job and return its row."""
    import warnings

    from gscompleter.apps.commands.complete import complete_folder
    from gscompleter.apps.commands.row_options import parse_row
    from gscompleter.apps.inputs.fetching import download_inputs
    from gscompleter.apps.report.batch_page import average_scores, make_batch_thumbnail
    from gscompleter.evaluation.memory import measure_peak_memory
    from gscompleter.jobs.costs import measure_costs
    from gscompleter.jobs.jobs import JOBS, THUMBNAILS

    warnings.filterwarnings("ignore", module="PIL")  # as the command line has it
    with measure_peak_memory() as peak, measure_costs() as meter:
        with (
            download_inputs(job.options) as given,
            place.open_folder(f"{JOBS}/{job.name}") as folder,
        ):
            summary = complete_folder(parse_row(given, folder))
            meter.begin("deliver")
            thumbnail = make_batch_thumbnail(folder)
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if thumbnail is not None:
            place.write(f"{THUMBNAILS}/{job.name}.jpg", thumbnail)
    return {**average_scores(summary), **sum_costs(meter.stages), "result_bytes": size} | {
        "peak_bytes": peak.bytes
    }


def sum_costs(stages: Mapping[str, Any]) -> dict[str, Any]:
    """Sum the costs of a job over its stages."""
    from dataclasses import asdict

    total = {
        name: sum(getattr(cost, name) for cost in stages.values())
        for name in ("seconds", "cpu_seconds", "read_bytes", "written_bytes")
    }
    return {"stages": {name: asdict(cost) for name, cost in stages.items()}, **total}
