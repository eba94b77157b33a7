"""The report page of an evaluation, made from its tables and plots."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gscompleter.apps.report.figures import draw_time_bars
from gscompleter.apps.report.finished import check_results, parse_content
from gscompleter.apps.report.page import Picture, Table, open_gallery, render_template
from gscompleter.apps.report.plain_words import format_number
from gscompleter.errors import InputError, quote_value
from gscompleter.evaluation.summary import GROUPS, Column, rank_stage
from gscompleter.io.json_file import read_json

TABLES_FILE = "tables.json"
TIMINGS_FILE = "timings.json"
ADVICE = "run `gscompleter tables` again"
PLOT_CAPTIONS = {
    "gain_by_hole": "ΔPSNR at the target by hole size",
    "gain_by_distance": "ΔPSNR at the target by distance from the context",
    "seconds": "Median seconds of a step by stage",
}


@dataclass(frozen=True)
class ScoreEntry:
    """An entry of a table of scores."""

    value: float | None
    cases: int


@dataclass(frozen=True)
class FidEntry:
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
class EvaluationTables:
    """The parts of `tables.json` that the page shows."""

    cases: int
    common: tuple[str, ...]
    methods: Mapping[str, Mapping[str, int | ScoreEntry]]
    gain_by_distance: Mapping[str, Mapping[str, float | None]]
    fid: FidEntry
    failures: tuple[Failure, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class MethodTiming:
    """Median seconds by stage and peak memory of a method."""

    seconds: Mapping[str, float]
    peak_bytes: float | None


def render_evaluation_page(folder: Path) -> str:
    """Render the page of the evaluation in `folder`.

    Raises:
        InputError: if the folder has no evaluation, or a damaged one.
    """
    check_results(folder, TABLES_FILE)
    tables = parse_content(
        EvaluationTables, read_json(folder / TABLES_FILE, ADVICE), folder / TABLES_FILE, ADVICE
    )
    timings = read_timings(folder / TIMINGS_FILE)
    return render_template(
        "evaluation.html",
        {
            "facts": [
                ("cases finished by all methods", f"{len(tables.common)} of {tables.cases}"),
                ("methods", str(len(tables.methods))),
                ("failed", str(len(tables.failures))),
            ],
            "scores": list(make_evaluation_tables(tables)),
            "notes": tables.notes,
            "distances": make_distance_table(tables),
            "fid": describe_fid(tables.fid),
            "plots": list(embed_plots(folder)),
            "bars": draw_time_bars("Median seconds of a step", get_total_seconds(timings)),
            "timings": make_timing_table(timings),
            "failures": make_failure_table(tables.failures),
        },
    )


def read_timings(path: Path) -> dict[str, MethodTiming]:
    """Read the timings by method."""
    content = read_json(path, ADVICE)
    if not isinstance(content, Mapping):
        raise InputError(f"{quote_value(path)} is not a file of timings; {ADVICE}.")
    methods = {name: value for name, value in content.items() if name != "steps"}
    return {
        name: parse_content(MethodTiming, value, path, ADVICE) for name, value in methods.items()
    }


def make_evaluation_tables(tables: EvaluationTables) -> Iterator[Table]:
    """Make the tables of scores, without columns that have no value."""
    for title, columns in GROUPS.items():
        present = [
            c for c in columns if any(get_score_entry(row, c) for row in tables.methods.values())
        ]
        rows = [
            [
                method,
                *(
                    format_score_entry(get_score_entry(row, column), column, len(tables.common))
                    for column in present
                ),
            ]
            for method, row in tables.methods.items()
        ]
        if present:
            yield Table(title, ["method", *(column.title for column in present)], rows)


def get_score_entry(row: Mapping[str, int | ScoreEntry], column: Column) -> ScoreEntry | None:
    """Return the entry of a method in a column, or None without a value."""
    score = row.get(column.key)
    return score if isinstance(score, ScoreEntry) and score.value is not None else None


def format_score_entry(score: ScoreEntry | None, column: Column, count: int) -> str:
    """Format a score, with the number of its cases if that is not `count`."""
    if score is None:
        return "–"
    number = format_number(score.value, column.digits)
    return number if score.cases == count else f"{number} ({score.cases})"


def make_distance_table(tables: EvaluationTables) -> Table | None:
    """Make the table of ΔPSNR by distance, or return None for a single distance."""
    gains = tables.gain_by_distance
    if len(gains) < 2:
        return None
    rows = [[m, *(format_number(gains[gap].get(m)) for gap in gains)] for m in tables.methods]
    caption = "Mean ΔPSNR in dB by frames from the target to the nearest context frame"
    return Table(caption, ["method", *gains], rows)


def describe_fid(fid: FidEntry) -> str:
    """Describe the FID of each method."""
    if fid.reason is not None:
        return f"FID: {fid.reason}."
    return (
        "FID: "
        + ", ".join(f"{method} {format_number(v)}" for method, v in fid.values.items())
        + "."
    )


def embed_plots(folder: Path) -> Iterator[tuple[Picture, str]]:
    """Embed the plots that exist."""
    gallery = open_gallery(folder)
    steps = {path.stem: "" for path in sorted(folder.glob("sequence_*.png"))}
    captions = {name: f"Steps of {name.removeprefix('sequence_')}" for name in steps}
    for name, caption in (PLOT_CAPTIONS | captions).items():
        if os.path.isfile(folder / f"{name}.png"):
            yield gallery.embed_exact(f"{name}.png", caption), caption


def get_total_seconds(timings: Mapping[str, MethodTiming]) -> dict[str, float]:
    """Return the total seconds of a step by method."""
    return {method: t.seconds["total"] for method, t in timings.items() if "total" in t.seconds}


def make_timing_table(timings: Mapping[str, MethodTiming]) -> Table:
    """Make the table of median seconds by stage and of peak memory."""
    stages = sorted({stage for t in timings.values() for stage in t.seconds}, key=rank_stage)
    rows = []
    for method, timing in timings.items():
        memory = None if timing.peak_bytes is None else timing.peak_bytes / 2**30
        seconds = (format_number(timing.seconds.get(stage)) for stage in stages)
        rows.append([method, *seconds, format_number(memory)])
    return Table(
        "Median seconds of a step and peak memory (GiB)", ["method", *stages, "memory"], rows
    )


def make_failure_table(failures: Sequence[Failure]) -> Table | None:
    """Make the table of failures, or return None without any."""
    rows = [[failure.case, failure.method, failure.reason] for failure in failures]
    return Table("Failed", ("case", "method", "reason"), rows) if rows else None
