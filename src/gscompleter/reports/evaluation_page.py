"""The report page of an evaluation, made from its tables and plots."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gscompleter.errors import InputError, quoted
from gscompleter.io.json_file import read_json
from gscompleter.reports.figures import time_bars
from gscompleter.reports.finished import as_written, check_results
from gscompleter.reports.page import Picture, Table, gallery_of, rendered
from gscompleter.reports.plain_words import shown
from gscompleter.reports.summary import GROUPS, Column, stage_place

TABLES = "tables.json"
TIMINGS = "timings.json"
ADVICE = "run `gscompleter tables` again"
PLOTS = {
    "gain_by_hole": "ΔPSNR at the target by hole size",
    "gain_by_distance": "ΔPSNR at the target by distance from the context",
    "seconds": "Median seconds of a step by stage",
}


@dataclass(frozen=True)
class Score:
    """An entry of a table of scores."""

    value: float | None
    cases: int


@dataclass(frozen=True)
class Fid:
    """FID of each method, or the reason why there is none."""

    values: Mapping[str, float]
    reason: str | None


@dataclass(frozen=True)
class Failure:
    """A case that a method did not finish."""

    case: str
    method: str
    reason: str


@dataclass(frozen=True)
class Tables:
    """The parts of `tables.json` that the page shows."""

    cases: int
    common: tuple[str, ...]
    methods: Mapping[str, Mapping[str, int | Score]]
    gain_by_distance: Mapping[str, Mapping[str, float | None]]
    fid: Fid
    failures: tuple[Failure, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Timing:
    """Median seconds by stage and peak memory of a method."""

    seconds: Mapping[str, float]
    peak_bytes: float | None


def evaluation_page(folder: Path) -> str:
    """Render the page of the evaluation in `folder`.

    Raises:
        InputError: if the folder has no evaluation, or a damaged one.
    """
    check_results(folder, TABLES)
    tables = as_written(Tables, read_json(folder / TABLES, ADVICE), folder / TABLES, ADVICE)
    timings = read_timings(folder / TIMINGS)
    return rendered(
        "evaluation.html",
        {
            "facts": [
                ("cases finished by all methods", f"{len(tables.common)} of {tables.cases}"),
                ("methods", str(len(tables.methods))),
                ("failed", str(len(tables.failures))),
            ],
            "scores": list(score_tables(tables)),
            "notes": tables.notes,
            "distances": distance_table(tables),
            "fid": fid_sentence(tables.fid),
            "plots": list(plots_of(folder)),
            "bars": time_bars("Median seconds of a step", totals(timings)),
            "timings": timing_table(timings),
            "failures": failure_table(tables.failures),
        },
    )


def read_timings(path: Path) -> dict[str, Timing]:
    """Read the timings by method."""
    content = read_json(path, ADVICE)
    if not isinstance(content, Mapping):
        raise InputError(f"{quoted(path)} is not a file of timings; {ADVICE}.")
    methods = {name: value for name, value in content.items() if name != "steps"}
    return {name: as_written(Timing, value, path, ADVICE) for name, value in methods.items()}


def score_tables(tables: Tables) -> Iterator[Table]:
    """Make the tables of scores, without columns that have no value."""
    for title, columns in GROUPS.items():
        present = [c for c in columns if any(cell_of(row, c) for row in tables.methods.values())]
        rows = [
            [
                method,
                *(
                    score_text(cell_of(row, column), column, len(tables.common))
                    for column in present
                ),
            ]
            for method, row in tables.methods.items()
        ]
        if present:
            yield Table(title, ["method", *(column.title for column in present)], rows)


def cell_of(row: Mapping[str, int | Score], column: Column) -> Score | None:
    """Return the entry of a method in a column, or None without a value."""
    score = row.get(column.key)
    return score if isinstance(score, Score) and score.value is not None else None


def score_text(score: Score | None, column: Column, count: int) -> str:
    """Format a score, with the number of its cases if that is not `count`."""
    if score is None:
        return "–"
    number = shown(score.value, column.digits)
    return number if score.cases == count else f"{number} ({score.cases})"


def distance_table(tables: Tables) -> Table | None:
    """Make the table of ΔPSNR by distance, or return None for a single distance."""
    gains = tables.gain_by_distance
    if len(gains) < 2:
        return None
    rows = [[m, *(shown(gains[gap].get(m)) for gap in gains)] for m in tables.methods]
    caption = "Mean ΔPSNR in dB by frames from the target to the nearest context frame"
    return Table(caption, ["method", *gains], rows)


def fid_sentence(fid: Fid) -> str:
    """Describe the FID of each method."""
    if fid.reason is not None:
        return f"FID: {fid.reason}."
    return "FID: " + ", ".join(f"{method} {shown(v)}" for method, v in fid.values.items()) + "."


def plots_of(folder: Path) -> Iterator[tuple[Picture, str]]:
    """Embed the plots that exist."""
    gallery = gallery_of(folder)
    steps = {path.stem: "" for path in sorted(folder.glob("sequence_*.png"))}
    captions = {name: f"Steps of {name.removeprefix('sequence_')}" for name in steps}
    for name, caption in (PLOTS | captions).items():
        if os.path.isfile(folder / f"{name}.png"):
            yield gallery.exact(f"{name}.png", caption), caption


def totals(timings: Mapping[str, Timing]) -> dict[str, float]:
    """Return the total seconds of a step by method."""
    return {method: t.seconds["total"] for method, t in timings.items() if "total" in t.seconds}


def timing_table(timings: Mapping[str, Timing]) -> Table:
    """Make the table of median seconds by stage and of peak memory."""
    stages = sorted({stage for t in timings.values() for stage in t.seconds}, key=stage_place)
    rows = []
    for method, timing in timings.items():
        memory = None if timing.peak_bytes is None else timing.peak_bytes / 2**30
        seconds = (shown(timing.seconds.get(stage)) for stage in stages)
        rows.append([method, *seconds, shown(memory)])
    return Table(
        "Median seconds of a step and peak memory (GiB)", ["method", *stages, "memory"], rows
    )


def failure_table(failures: Sequence[Failure]) -> Table | None:
    """Make the table of failures, or return None without any."""
    rows = [[failure.case, failure.method, failure.reason] for failure in failures]
    return Table("Failed", ("case", "method", "reason"), rows) if rows else None
