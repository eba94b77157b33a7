"""The report page of an evaluation, made from its tables and plots."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from gscompleter.apps.report.page import Picture, open_gallery, render_template
from gscompleter.apps.report.plain_words import format_number
from gscompleter.apps.report.schema import check_results, parse_content
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
    path = folder / TABLES_FILE
    tables = parse_content(EvaluationTables, read_json(path, ADVICE), path, ADVICE)
    timings = read_timings(folder / TIMINGS_FILE)
    stages = {stage for timing in timings.values() for stage in timing.seconds}
    return render_template(
        "evaluation.html",
        {
            "tables": tables,
            "scores": list_scores(tables),
            "plots": list(embed_plots(folder)),
            "timings": timings,
            "totals": {m: t.seconds["total"] for m, t in timings.items() if "total" in t.seconds},
            "stages": sorted(stages, key=rank_stage),
        },
    )


def read_timings(path: Path) -> dict[str, MethodTiming]:
    """Read the timings by method."""
    content = parse_content(dict, read_json(path, ADVICE), path, ADVICE)
    return {
        name: parse_content(MethodTiming, value, path, ADVICE)
        for name, value in content.items()
        if name != "steps"
    }


def list_scores(tables: EvaluationTables) -> dict[str, tuple[list[str], list[list[str]]]]:
    """List the head and the rows of each table of scores, without columns that have no value."""
    found = {}
    for title, columns in GROUPS.items():
        rows = {m: [get_score(row, c) for c in columns] for m, row in tables.methods.items()}
        present = [k for k in range(len(columns)) if any(row[k] for row in rows.values())]
        texts = [
            [method, *(format_score(row[k], columns[k], len(tables.common)) for k in present)]
            for method, row in rows.items()
        ]
        if present:
            found[title] = (["method", *(columns[k].title for k in present)], texts)
    return found


def get_score(row: Mapping[str, int | ScoreEntry], column: Column) -> ScoreEntry | None:
    """Return the entry of a method in a column, or None without a value."""
    score = row.get(column.key)
    return score if isinstance(score, ScoreEntry) and score.value is not None else None


def format_score(score: ScoreEntry | None, column: Column, count: int) -> str:
    """Format a score, with the number of its cases if that is not `count`."""
    if score is None:
        return "–"
    number = format_number(score.value, column.digits)
    return number if score.cases == count else f"{number} ({score.cases})"


def embed_plots(folder: Path) -> Iterator[tuple[Picture, str]]:
    """Embed the plots that exist."""
    gallery = open_gallery(folder)
    steps = [path.stem for path in sorted(folder.glob("sequence_*.png"))]
    captions = {name: f"Steps of {name.removeprefix('sequence_')}" for name in steps}
    for name, caption in (PLOT_CAPTIONS | captions).items():
        if os.path.isfile(folder / f"{name}.png"):
            yield gallery.embed(f"{name}.png", caption, exact=True), caption
