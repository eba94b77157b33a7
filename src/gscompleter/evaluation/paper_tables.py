"""Tables of several models and protocols, with standard errors and paired differences."""

from __future__ import annotations

import json
import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from scipy.stats import t as student_t

from gscompleter.evaluation.columns import BY_KEY, Column
from gscompleter.evaluation.paper import TableSpec
from gscompleter.evaluation.run_facts import (
    RunFacts,
    describe_facts,
    read_run_facts,
    spell_greek,
)
from gscompleter.evaluation.tables import (
    ABSENT_NOTES,
    RunSummary,
    compute_fids,
    format_latex,
    format_markdown,
    format_score,
    read_run_rows,
    summarize_run,
)
from gscompleter.system.files.text import encode_text
from gscompleter.system.files.writing import replace_file

SIGNIFICANCE = 0.05
"""Largest two-sided p at which a difference is more than noise."""
ABOUT = (
    "Mean ± standard error over scenes; in brackets the mean of the paired differences to "
    "*{baseline}*, with ≈ if it is within noise (t test over scenes, p > 0.05) or of one scene. "
    "Cases: {cases}."
)


@dataclass(frozen=True)
class Estimate:
    """A mean over cases with its standard error, or None for a single scene."""

    mean: float
    error: float | None
    num_scenes: int

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of the error: cases of one scene count as one observation."""
        return self.num_scenes - 1

    @property
    def p_value(self) -> float:
        """Two-sided p of Student's t test that the mean is zero; 1 for a single scene."""
        if self.error is None or self.mean == 0:
            return 1.0
        # Student's t with infinite statistic: all scenes have the same difference.
        if self.error == 0:
            return 0.0
        return float(2 * student_t.sf(abs(self.mean) / self.error, self.degrees_of_freedom))

    @property
    def is_noise(self) -> bool:
        """True unless the mean differs from zero significantly.

        With few scenes that is far more than two standard errors: 3.2 of them with four scenes.
        """
        return self.p_value > SIGNIFICANCE


@dataclass(frozen=True)
class Cell:
    """A number of a method, and the mean of its paired differences to the baseline."""

    value: float | None
    error: float | None = None
    difference: Estimate | None = None
    is_noise: bool = True
    cases: Mapping[str, float] | None = None
    """Value of each case, for other comparisons."""


@dataclass(frozen=True)
class TableRow:
    """The cells of a method with a model and a protocol."""

    model: str
    protocol: str
    method: str
    cells: Mapping[str, Cell]
    """Cells by the key of their column."""


@dataclass(frozen=True)
class PaperTable:
    """A filled table of the paper."""

    spec: TableSpec
    rows: Sequence[TableRow]
    num_cases: Mapping[str, int]
    """Number of cases that all methods finished, by model and protocol."""
    notes: Sequence[str]
    """Failed cases, and the reason why there is no FID."""
    facts: Mapping[str, RunFacts]
    """What each run was made with, by model and protocol."""
    compared: str = "Ψ"
    """Title of the column of the models."""

    @property
    def columns(self) -> list[Column]:
        """Columns in which any row has a value."""
        return [BY_KEY[key] for key in self.spec.columns if self.has_value(key)]

    def has_value(self, key: str) -> bool:
        """Return True if any row has a value in a column."""
        return any(row.cells[key].value is not None for row in self.rows)


def get_scene(case: str) -> str:
    """Return the scene in the name of a case, which may be followed by `|` and its run."""
    return case.split("|")[0].rpartition(" ")[0]


def estimate_mean(values: Mapping[str, float]) -> Estimate:
    """Average over cases, with the standard error of a mean whose cases are clustered by scene.

    The error is sqrt(G / (G - 1) Σ_g (Σ_i∈g (x_i - mean))²) / n for n cases of G scenes.
    """
    mean = statistics.fmean(values.values())
    # Residuals of one scene are added before they are squared, as they may be correlated.
    sums: dict[str, float] = defaultdict(float)
    for case, value in values.items():
        sums[get_scene(case)] += value - mean
    count = len(sums)
    if count < 2:
        return Estimate(mean, None, count)
    spread = count / (count - 1) * math.fsum(total**2 for total in sums.values())
    return Estimate(mean, math.sqrt(spread) / len(values), count)


def compare_cases(values: Mapping[str, float], others: Mapping[str, float]) -> Estimate | None:
    """Average the differences over the cases that both have; None if there are none."""
    differences = {case: value - others[case] for case, value in values.items() if case in others}
    return estimate_mean(differences) if differences else None


def fill_table(spec: TableSpec, runs: Mapping[tuple[str, str], Path]) -> PaperTable:
    """Fill a table from runs of `evaluate`, given by model and protocol."""
    rows: list[TableRow] = []
    counts = {}
    notes = []
    facts = {}
    for (model, protocol), folder in runs.items():
        # Every method is averaged over the same cases, those that all finished.
        own = [row for row in read_run_rows(folder) if row["method"] in spec.methods]
        summary = summarize_run(own)
        fids = compute_fids(folder, summary) if "fid" in spec.columns else {}
        notes += [f"Failed: {' '.join(failure)}" for failure in summary.failures]
        notes += [fids] if isinstance(fids, str) else []
        name = f"{model}, {protocol}" if protocol else model
        counts[name] = len(summary.common_tasks)
        facts[name] = read_run_facts(folder, own)
        for method in spec.methods:
            cells = fill_cells(spec, summary, method)
            # FID is one number of all images, without a case to pair.
            if not isinstance(fids, str) and fids:
                cells["fid"] = Cell(fids[method])
            rows.append(TableRow(model, protocol, method, cells))
    return PaperTable(spec, rows, counts, list(dict.fromkeys(notes)), facts)


def fill_comparison(
    title: str,
    compared: str,
    methods: Sequence[str],
    columns: Sequence[str],
    runs: Mapping[str, Path],
) -> PaperTable:
    """Fill a table that compares models of one kind, from runs of `evaluate` with one each.

    Differences are those of a method to itself with the first model, over the cases that both
    finished.
    """
    first = next(iter(runs))
    spec = TableSpec(title, columns=tuple(columns), methods=tuple(methods), baseline=first)
    loaded = {model: read_run_rows(folder) for model, folder in runs.items()}
    summaries = {model: summarize_run(rows) for model, rows in loaded.items()}
    facts = {model: read_run_facts(runs[model], rows) for model, rows in loaded.items()}
    rows = []
    for model, summary in summaries.items():
        for method in methods:
            values = collect_values(summary, method, columns)
            others: dict[str, dict[str, float]] = {key: {} for key in columns}
            if model != first:
                others = collect_values(summaries[first], method, columns)
            cells = {key: fill_cell(BY_KEY[key], values[key], others[key]) for key in columns}
            rows.append(TableRow(model, "", method, cells))
    counts = {model: len(summary.common_tasks) for model, summary in summaries.items()}
    failures = [failure for summary in summaries.values() for failure in summary.failures]
    notes = [f"Failed: {' '.join(failure)}" for failure in failures]
    return PaperTable(spec, rows, counts, list(dict.fromkeys(notes)), facts, compared)


def fill_cells(spec: TableSpec, summary: RunSummary, method: str) -> dict[str, Cell]:
    """Fill the cells of a method, by the key of their column."""
    values = collect_values(summary, method, spec.columns)
    # The baseline itself has no difference to show.
    others: dict[str, dict[str, float]] = {key: {} for key in spec.columns}
    if method != spec.baseline:
        others = collect_values(summary, spec.baseline, spec.columns)
    return {key: fill_cell(BY_KEY[key], values[key], others[key]) for key in spec.columns}


def collect_values(
    summary: RunSummary, method: str, columns: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Collect the values of a method in each column, by case."""
    values: dict[str, dict[str, float]] = {key: {} for key in columns}
    for key in columns:
        for task, row in zip(summary.common_tasks, summary.rows[method], strict=True):
            value = BY_KEY[key].compute_row(row)
            if value is not None:
                values[key][task] = value
    return values


def fill_cell(column: Column, values: dict[str, float], baseline: Mapping[str, float]) -> Cell:
    """Reduce the values of the cases; only means have an error and a difference."""
    if not values:
        return Cell(None)
    if column.reduce_tasks is not statistics.fmean:
        return Cell(column.reduce_tasks([*values.values()]), cases=values)
    estimate = estimate_mean(values)
    difference = compare_cases(values, baseline)
    is_noise = difference is None or difference.is_noise
    return Cell(estimate.mean, estimate.error, difference, is_noise, values)


def write_paper_table(path: Path, table: PaperTable) -> None:
    """Write a table as .md, .tex and .json beside each other; `path` has no suffix."""
    texts = {".md": format_paper_markdown(table), ".tex": format_paper_latex(table)}
    content = {
        "title": table.spec.title,
        "baseline": table.spec.baseline,
        "cases": table.num_cases,
        "made_with": {name: facts.to_json() for name, facts in table.facts.items()},
        "rows": [asdict(row) for row in table.rows],
    }
    texts[".json"] = json.dumps(content, indent=1) + "\n"
    for suffix, text in texts.items():
        with replace_file(path.with_name(path.name + suffix)) as file:
            file.write(encode_text(text))


def format_rows(
    table: PaperTable, format_cell: Callable[[Column, Cell], str]
) -> tuple[list[str], list[list[str]]]:
    """Return the titles and the cells of a table; columns with a single name are left out."""
    names: dict[str, Callable[[TableRow], str]] = {
        table.compared: lambda row: row.model,
        "protocol": lambda row: row.protocol,
        "method": lambda row: row.method,
    }
    shown = {
        title: get_name
        for title, get_name in names.items()
        if len({get_name(row) for row in table.rows}) > 1
    }
    shown["method"] = names["method"]
    head = [*shown, *(column.title for column in table.columns)]
    rows = [
        [get_name(row) for get_name in shown.values()]
        + [format_cell(column, row.cells[column.key]) for column in table.columns]
        for row in table.rows
    ]
    return head, rows


def format_paper_number(column: Column, cell: Cell, error: str, difference: str) -> str:
    """Format a cell with templates of its error and its difference."""
    text = format_score(cell.value, column.digits)
    digits = column.digits
    if cell.error is not None:
        text += error.format(f"{cell.error:.{digits}f}")
    if cell.difference is not None:
        mark = "≈" if cell.is_noise else ""
        text += difference.format(f"{mark}{cell.difference.mean:+.{digits}f}")
    return text


def format_paper_markdown(table: PaperTable) -> str:
    """Format a table with its title and notes."""
    counts = [f"{count} ({name})" for name, count in table.num_cases.items()]
    about = ABOUT.format(baseline=table.spec.baseline, cases=", ".join(counts))
    head, rows = format_rows(table, partial(format_paper_number, error=" ± {}", difference=" ({})"))
    notes = [f"{note}\n" for note in table.notes]
    body = [format_markdown(head, rows), *describe_missing(table), *notes]
    made_with = "\n".join(f"* {line}" for line in describe_facts(table.facts))
    return "\n".join([f"## {table.spec.title}\n", f"{made_with}\n", f"{about}\n", *body])


def describe_missing(table: PaperTable) -> list[str]:
    """Name the columns without a value, with the reason if it is known."""
    absent = [key for key in table.spec.columns if not table.has_value(key)]
    names = ", ".join(BY_KEY[key].title for key in absent)
    # Without any value no case was finished by all methods, which no package mends.
    has_values = len(absent) < len(table.spec.columns)
    notes = [f"{ABSENT_NOTES[key]}\n" for key in absent if has_values and key in ABSENT_NOTES]
    return [f"Without a value: {names}.\n", *notes] if absent else []


def format_paper_latex(table: PaperTable) -> str:
    """Format a table with booktabs."""
    cell = partial(format_paper_number, error=r"{{\tiny$\pm${}}}", difference=r"~{{\tiny({})}}")
    text = format_latex(*format_rows(table, cell))
    about = [table.spec.title, *describe_facts(table.facts)]
    return "\n".join([*(f"% {spell_greek(line)}" for line in about), text]) + "\n"
