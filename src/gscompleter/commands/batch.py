"""The command `batch`: many completions, shared among processes and machines, and a page on all."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from annotated_types import Interval

from gscompleter.batch.engines import EngineName
from gscompleter.commands.options import EngineOptions

if TYPE_CHECKING:
    from gscompleter.batch.jobs import Job, Outcome
    from gscompleter.batch.places import Place


@dataclass(frozen=True, kw_only=True)
class BatchOptions(EngineOptions):
    """Complete many scenes: each once, whatever is stopped or killed meanwhile.

    Run again, also on other machines at the same time, it goes on with what is left. A scene that
    cannot be completed is a row with its reason. OUT has a folder for each job in jobs/, table.csv
    and index.html.
    """

    manifest: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MANIFEST")]
    """What to complete: a .csv or .jsonl whose rows have options of `complete` by their names, and
    `folder` for SCENE; or a folder whose folders are scenes. A row may have a `name`. Paths are
    relative to the manifest, or addresses such as s3://bucket/scene."""
    out: str
    """Folder for the results, a new one or that of an earlier run to go on with; or an address."""
    engine: EngineName = "local"
    """Who does the work: processes of this machine, tasks of Ray, or jobs of SLURM by submitit."""
    retries: Annotated[int, Interval(ge=0, le=100)] = 2
    """How often a job is tried again whose process was killed, or that failed with anything but a
    sentence on its input."""
    rerun: Literal["nothing", "failures"] = "nothing"
    """What of an earlier run is done once more: jobs that failed."""
    each: tuple[str, ...] = ()
    """Options of `complete` for every row that has not its own, as in --each resolution=256."""
    shard: str | None = None
    """i/n does every n-th job from the i-th on; auto takes both from an array of SLURM."""


@dataclass(frozen=True)
class Counts:
    """What a call did, in jobs."""

    done: int
    failed: int
    """Of those that have a row now, how many say why they came to nothing."""
    skipped: int
    """Had a row before."""
    skipped_failed: int = 0
    """Those of them whose row records a failure."""

    def sentence(self) -> str:
        """Summarize the counts, and name the option that retries what failed before."""
        before = f"there before {self.skipped}"
        if self.skipped_failed:
            before += f", {self.skipped_failed} of them failed (--rerun failures does these again)"
        return f"Done {self.done}, failed {self.failed}, {before}."


def run_batch(options: BatchOptions) -> None:
    """Complete what the manifest names, write the table and the page, and say what was done."""
    # Here, so that `--help` answers at once.
    from rich.console import Console

    from gscompleter.batch.jobs import claim_folder, missing
    from gscompleter.batch.manifest import read_manifest
    from gscompleter.batch.places import place_of
    from gscompleter.batch.rounds import BatchRows, Rounds
    from gscompleter.batch.shards import parse_shard
    from gscompleter.commands.engines import engine_for, pairs
    from gscompleter.progress import preparing, shown_on

    number, count = parse_shard(options.shard, os.environ)
    console = Console(stderr=True, quiet=options.quiet, highlight=False)
    with shown_on(None if options.quiet else console):
        with preparing("reading the manifest"):
            jobs = read_manifest(options.manifest, pairs(options.each, "each"))
            place = place_of(absolute(options.out))
            engine = engine_for(options, place.name)
            claim_folder(place)
            share = jobs[number::count]
            left = missing(share, place, options.rerun == "failures")
            names = {job.name for job in left}
            failed_before = count_failed(place, [job for job in share if job.name not in names])
        rounds = Rounds(place, BatchRows(place), left, options.retries)
        perform = CompletingJob(absolute(options.out), options.retries)
        failed = sum(
            outcome.state == "failed"
            for outcome in followed(rounds.outcomes(engine, perform), len(left))
        )
        with preparing("table"):
            show(place, jobs)
    counts = Counts(len(left) - failed, failed, len(share) - len(left), failed_before)
    sentence = f"{counts.sentence()} All results: {options.out}/index.html"
    console.print(sentence, markup=False, soft_wrap=True)


def count_failed(place: Place, jobs: Iterable[Job]) -> int:
    """Count the jobs whose row says that they came to nothing."""
    from gscompleter.batch.jobs import read_row

    rows = (read_row(place, job.name) for job in jobs)
    return sum(row is not None and row["state"] == "failed" for row in rows)


def absolute(out: str) -> str:
    """A path as workers elsewhere understand it; an address as it is."""
    return out if "://" in out else os.path.abspath(out)


def followed(outcomes: Iterable[Outcome], total: int) -> Iterator[Outcome]:
    """`outcomes`, shown as they come: how many, how fast, and how long the others take."""
    from gscompleter.progress import Activity, going_on

    if not total:
        return
    activity = Activity("completing", total)
    with going_on(activity):
        for outcome in outcomes:
            yield outcome
            activity.stepped()
            minutes = (activity.last - activity.begun) / 60
            activity.name = f"completing ({activity.done / minutes:.1f} a minute)"


def show(place: Place, jobs: Sequence[Job]) -> None:
    """Write the table and the page on all rows that are there, and once more where others came
    meanwhile: of shards that end at the same moment, one sees the rows of all."""
    from gscompleter.batch.jobs import ROWS
    from gscompleter.reports.batch_page import write_overview

    seen = None
    while seen != (there := place.names(ROWS)):
        seen = there
        write_overview(place, [job for job in jobs if f"{job.name}.json" in there])


@dataclass(frozen=True)
class CompletingJob:
    """Completes the scene of a job, in whatever process it is called."""

    out: str
    """The folder of the batch."""
    retries: int

    def __call__(self, job: Job) -> Outcome:
        from gscompleter.batch.jobs import settle
        from gscompleter.batch.places import place_of

        place = place_of(self.out)
        return settle(job, place, lambda: completed(job, place), self.retries)


def completed(job: Job, place: Place) -> dict[str, Any]:
    """Complete the scene of a job; returns what its row says of it.

    Models with weights are kept by those who load them, so that a worker loads each once.
    """
    import warnings

    from gscompleter.batch.costs import metered
    from gscompleter.batch.jobs import JOBS, THUMBNAILS
    from gscompleter.commands.complete import complete_folder
    from gscompleter.commands.fetching import fetched
    from gscompleter.commands.row_options import options_of
    from gscompleter.reports.batch_page import scores_of, thumbnail_of
    from gscompleter.runs.memory import peak_memory

    warnings.filterwarnings("ignore", module="PIL")  # as the command line has it
    with peak_memory() as peak, metered() as meter:
        with fetched(job.options) as given, place.folder(f"{JOBS}/{job.name}") as folder:
            summary, _ = complete_folder(options_of(given, folder))
            meter.begin("deliver")
            thumbnail = thumbnail_of(folder)
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if thumbnail is not None:
            place.write(f"{THUMBNAILS}/{job.name}.jpg", thumbnail)
    return {**scores_of(summary), **cost_of(meter.stages), "result_bytes": size} | {
        "peak_bytes": peak.bytes
    }


def cost_of(stages: Mapping[str, Any]) -> dict[str, Any]:
    """What a job cost, stage by stage and in all."""
    from dataclasses import asdict

    total = {
        name: sum(getattr(cost, name) for cost in stages.values())
        for name in ("seconds", "cpu_seconds", "read_bytes", "written_bytes")
    }
    return {"stages": {name: asdict(cost) for name, cost in stages.items()}, **total}
