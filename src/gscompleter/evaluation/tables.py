"""Tables from the rows of a run: scores in one set of files, timings in another.

The tables of scores depend on nothing but scores, so that a run that was stopped and went on gives
the same bytes as one that was not.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError
from gscompleter.evaluation.methods import METHODS
from gscompleter.evaluation.store import CASES, RUN, read_json
from gscompleter.io.files import replacing

Row = dict[str, Any]
"""What `evaluate` writes for a case and a method."""


@dataclass(frozen=True)
class Column:
    """A score, as a table shows it."""

    key: str
    title: str
    digits: int
    of: Callable[[dict[str, Any]], float | None]
    """Takes the scores of a row. None where no truth exists."""


def _part(key: str, when: str) -> Callable[[dict[str, Any]], float | None]:
    return lambda scores: None if scores[key] is None else scores[key][when]


COLUMNS = (
    Column("target_psnr_before", "PSNR before", 2, _part("target_psnr", "before")),
    Column("target_psnr", "PSNR", 2, _part("target_psnr", "after")),
    Column("target_ssim_before", "SSIM before", 3, _part("target_ssim", "before")),
    Column("target_ssim", "SSIM", 3, _part("target_ssim", "after")),
    Column("hole_psnr", "PSNR in holes", 2, lambda s: s["hole_psnr"]),
    Column("neighbours_before", "neighbours before", 2, _part("neighbours_psnr", "before")),
    Column("neighbours", "neighbours", 2, _part("neighbours_psnr", "after")),
    Column(
        "context", "context", 2, lambda s: statistics.fmean(c["after"] for c in s["context_psnr"])
    ),
    Column(
        "context_change",
        "worst change of context",
        2,
        lambda s: min(c["after"] - c["before"] for c in s["context_psnr"]),
    ),
    Column("depth_observed", "AbsRel observed", 4, lambda s: s["depth_observed"]),
    Column("depth_hole", "AbsRel in holes", 4, lambda s: s["depth_hole"]),
    Column("depth_rim", "depth step at rim", 4, lambda s: s["depth_rim"]),
)
"""PSNR in dB; AbsRel and the step at the rim are shares of the depth. The worst change is the
lowest over the cases; everything else is a mean over them."""

WORST = "context_change"


@dataclass(frozen=True)
class Cell:
    """A mean (or the worst) over the cases that have the score."""

    value: float | None
    count: int


@dataclass(frozen=True)
class Summary:
    """All that the tables show."""

    methods: tuple[str, ...]
    cases: int
    """How many cases there are rows of."""
    common: tuple[str, ...]
    """Names of the cases that all methods finished."""
    cells: dict[str, dict[str, Cell]]
    """By method and column."""
    finished: dict[str, int]
    """By method, the cases it finished."""
    failures: tuple[tuple[str, str, str], ...]
    """Case, method, reason."""
    seconds: dict[str, tuple[float | None, float | None]]
    """By method, medians of its own time and of the context's."""


def tables(out: Path) -> Summary:
    """Read all rows below `out` and write tables.md, .tex and .json, and timings.md and .json.

    Raises:
        InputError: where `out` is no folder of results, or has no rows or a damaged one.
    """
    summary = summarize(read_rows(out))
    texts = {
        "tables.md": score_markdown(summary),
        "tables.tex": score_latex(summary),
        "tables.json": score_json(summary),
        "timings.md": timing_markdown(summary),
        "timings.json": timing_json(summary),
    }
    for name, text in texts.items():
        with replacing(out / name) as file:
            file.write(text.encode())
    return summary


def read_rows(out: Path) -> list[Row]:
    """The rows of a run, in the order of cases and methods.

    Raises:
        InputError: where there are none, or one is damaged.
    """
    if not (out / RUN).is_file():
        raise InputError(f"{out} holds no run; name a folder that `evaluate` wrote.")
    paths = sorted((out / CASES).glob("*/*.json"))
    if not paths:
        raise InputError(f"The run in {out} has no rows yet; let `evaluate` finish a case first.")
    rows = []
    for path in paths:
        row = read_json(path)
        try:
            row["case"]["name"], row["method"], row["error"], row["scores"], row["seconds"]
        except (KeyError, TypeError) as error:
            raise InputError(f"{path} is no row of scores; delete it and run again.") from error
        rows.append(row)
    order = {name: number for number, name in enumerate(METHODS)}
    return sorted(
        rows, key=lambda r: (r["case"]["name"], order.get(r["method"], len(order)), r["method"])
    )


def summarize(rows: Sequence[Row]) -> Summary:
    """Means over the cases that all methods finished, so that they compare the same cases."""
    order = {name: number for number, name in enumerate(METHODS)}
    names = {row["method"] for row in rows}
    methods = tuple(sorted(names, key=lambda name: (order.get(name, len(order)), name)))
    done: dict[str, dict[str, Row]] = {name: {} for name in methods}
    for row in rows:
        if row["error"] is None:
            done[row["method"]][row["case"]["name"]] = row
    cases = sorted({row["case"]["name"] for row in rows})
    common = tuple(name for name in cases if all(name in done[method] for method in methods))
    chosen = {method: [done[method][name] for name in common] for method in methods}
    return Summary(
        methods,
        len(cases),
        common,
        {
            m: {c.key: cell_of([r["scores"] for r in chosen[m]], c) for c in COLUMNS}
            for m in methods
        },
        {method: len(done[method]) for method in methods},
        tuple((r["case"]["name"], r["method"], r["error"]) for r in rows if r["error"] is not None),
        {
            method: (
                _median([row["seconds"]["method"] for row in chosen[method]]),
                _median([row["seconds"]["context"] for row in chosen[method]]),
            )
            for method in methods
        },
    )


def cell_of(scores: Sequence[dict[str, Any]], column: Column) -> Cell:
    """The mean (or the worst) of a column over the rows that have it."""
    values = [value for value in map(column.of, scores) if value is not None]
    if not values:
        return Cell(None, 0)
    return Cell(min(values) if column.key == WORST else statistics.fmean(values), len(values))


def _median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None


def shown(cell: Cell, column: Column, cases: int) -> str:
    """The number, and of how many cases it is where that is not all of them."""
    if cell.value is None:
        return "–"
    number = f"{cell.value:.{column.digits}f}"
    return number if cell.count == cases else f"{number} ({cell.count})"


def score_cells(summary: Summary) -> list[list[str]]:
    """The table of scores as text, a row per method."""
    n = len(summary.common)
    return [
        [method, *(shown(summary.cells[method][c.key], c, n) for c in COLUMNS)]
        for method in summary.methods
    ]


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table, its first column to the left and the others to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def score_markdown(summary: Summary) -> str:
    """Scores, what they are over, and what failed."""
    text = (
        f"Over the {len(summary.common)} of {summary.cases} cases that all methods finished. A "
        "number in brackets is how many of them have the score, where not all have it.\n\n"
    )
    text += markdown(["method", *(column.title for column in COLUMNS)], score_cells(summary))
    if summary.failures:
        rows = [[cell.replace("|", "\\|") for cell in failure] for failure in summary.failures]
        text += "\nFailed:\n\n" + markdown(["case", "method", "reason"], rows)
    return text


def score_latex(summary: Summary) -> str:
    """The table of scores for LaTeX with booktabs."""
    lines = [
        f"% Over the {len(summary.common)} of {summary.cases} cases that all methods finished.",
        rf"\begin{{tabular}}{{l{'r' * len(COLUMNS)}}}",
        r"\toprule",
        " & ".join(["method", *(column.title for column in COLUMNS)]) + r" \\",
        r"\midrule",
    ]
    for row in score_cells(summary):
        lines.append(" & ".join(row).replace("_", r"\_").replace("–", "--") + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def score_json(summary: Summary) -> str:
    """The same with all digits."""
    methods = {
        method: {
            "finished": summary.finished[method],
            **{
                key: {"value": cell.value, "cases": cell.count}
                for key, cell in summary.cells[method].items()
            },
        }
        for method in summary.methods
    }
    failures = [
        {"case": case, "method": method, "reason": reason}
        for case, method, reason in summary.failures
    ]
    content = {
        "cases": summary.cases,
        "common": list(summary.common),
        "methods": methods,
        "failures": failures,
    }
    return json.dumps(content, indent=1) + "\n"


def timing_markdown(summary: Summary) -> str:
    """Median seconds per case."""

    def cell(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f}"

    rows = [[method, *map(cell, summary.seconds[method])] for method in summary.methods]
    return (
        f"Median seconds over the {len(summary.common)} cases that all methods finished.\n\n"
        + markdown(["method", "method alone", "context before it"], rows)
    )


def timing_json(summary: Summary) -> str:
    """The same with all digits."""
    content = {
        method: {"method": own, "context": context}
        for method, (own, context) in summary.seconds.items()
    }
    return json.dumps(content, indent=1) + "\n"
