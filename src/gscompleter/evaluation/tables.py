"""Tables of a run: scores in three formats, and timings in a file of their own.

Score files contain no timings, so an interrupted and resumed run gives the same bytes.
"""

from __future__ import annotations

import json
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from gscompleter.evaluation.columns import (
    COLUMN_GROUPS,
    MIN_GEOMETRY_PIXELS,
    PSNR,
    PSNR_BEFORE,
    Column,
    RunRow,
    StepRow,
)
from gscompleter.evaluation.methods import METHODS
from gscompleter.evaluation.metrics.perceptual import compute_fid
from gscompleter.evaluation.metrics.st_lpips import MIN_NETWORK_SIDE
from gscompleter.evaluation.run_facts import RunFacts, read_run_facts, spell_greek
from gscompleter.evaluation.store import (
    get_step_path,
    get_task_folder,
    get_truth_path,
    list_row_paths,
    read_run_file,
    read_run_settings,
)
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import read_image
from gscompleter.system.files.text import encode_text
from gscompleter.system.files.writing import replace_file
from gscompleter.system.timing import STAGES

Fids = dict[str, float] | str
"""The Fréchet inception distance (FID) of each method, or the reason why there is none."""

STAGE_ORDER = ("reconstruct", *STAGES, "optimize")
"""Order of stages in the tables."""
FEW_PIXELS_NOTE = (
    f"A geometry score counts if it is measured over at least {MIN_GEOMETRY_PIXELS} pixels."
)
REGGS_NOTE = (
    "reggs gets our metric lift and the true poses. RegGS in its paper gets neither, so this "
    "row is not comparable with that paper."
)
ABSENT_NOTES = {
    "lpips_vgg": (
        "LPIPS: not available. It needs `pip install 'gscompleter[evaluation]'` and, the first "
        "time, a connection; then score the run again to add the columns."
    ),
    "st_lpips": (
        f"ST-LPIPS: not available. It needs images whose sides have {MIN_NETWORK_SIDE} pixels or "
        "more, and `pip install stlpips-pytorch`, which holds its weights; then score the run "
        "again to add the column."
    ),
    "hole_flip": (
        "FLIP: not available. It needs a hole at some target, and "
        "`pip install 'gscompleter[evaluation]'`; then score the run again to add the columns."
    ),
}
"""Reasons why the group of a column is absent, where other columns have values."""
LATEX_SIGNS = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "_%&#"},
        "–": "--",
        "≈": r"$\approx$",
        "Ψ": r"$\Psi$",
        "Φ": r"$\Phi$",
        "Δ": r"$\Delta$",
    }
)
"""Replacements for signs that are commands of LaTeX, or that pdfLaTeX does not know."""


@dataclass(frozen=True)
class RunSummary:
    """All data of the tables."""

    methods: tuple[str, ...]
    tasks: tuple[str, ...]
    common_tasks: tuple[str, ...]
    """Tasks that all methods finished."""
    rows: Mapping[str, tuple[RunRow, ...]]
    """Rows of the common tasks in their order, by method."""
    sequences: Mapping[str, Mapping[str, Sequence[StepRow]]]
    """Finished steps by task of several steps and by method."""
    finished: Mapping[str, int]
    """Number of finished tasks by method."""
    failures: tuple[tuple[str, str, str], ...]
    """Task, method, reason."""

    @cached_property
    def groups(self) -> dict[str, list[Column]]:
        """Columns in which any method has a value, by the title of their table."""
        groups = {
            title: [column for column in columns if self.has_value(column)]
            for title, columns in COLUMN_GROUPS.items()
        }
        if not self.sequences:
            del groups["Sequences"]
        return {title: columns for title, columns in groups.items() if columns}

    @property
    def columns(self) -> list[Column]:
        """Columns of all groups."""
        return [column for group in self.groups.values() for column in group]

    @property
    def notes(self) -> list[str]:
        """Notes on the tables."""
        has_geometry = any(title.startswith("Geometry") for title in self.groups)
        notes = {FEW_PIXELS_NOTE: has_geometry, REGGS_NOTE: "reggs" in self.methods}
        return [note for note, is_needed in notes.items() if is_needed]

    def compute_cell(self, method: str, column: Column) -> tuple[float | None, int]:
        """Reduce the known values of the tasks as `column` says, and count them."""
        values = [column.compute_row(row) for row in self.rows[method]]
        known = [value for value in values if value is not None]
        return column.reduce_tasks(known) if known else None, len(known)

    def has_value(self, column: Column) -> bool:
        """Return True if any method has a value."""
        return any(self.compute_cell(method, column)[1] for method in self.methods)

    def compute_seconds(self, method: str) -> dict[str, float]:
        """Compute the median wall time over the steps by stage.

        `reconstruct` is Ψ on the photographs, once per task; `total` does not include it.
        """
        rows = self.rows[method]
        if not rows:
            return {}
        steps = [step["seconds"] for row in rows for step in row["steps"]]
        stages = sorted({stage for step in steps for stage in step}, key=rank_stage)
        # A stage that a step did not run took no time.
        medians = {s: statistics.median(step.get(s, 0.0) for step in steps) for s in stages}
        return {"reconstruct": statistics.median(r["reconstruct_seconds"] for r in rows), **medians}

    def find_peak_bytes(self, method: str) -> int | None:
        """Return the peak memory of all steps, or None if it is unknown."""
        peaks = (step["peak_bytes"] for row in self.rows[method] for step in row["steps"])
        return max((peak for peak in peaks if peak is not None), default=None)


def read_run_rows(out: Path) -> list[RunRow]:
    """Read the rows of a run."""
    read_run_settings(out)  # for its error: the folder may hold no run
    rows = {path: read_run_file(path) for path in list_row_paths(out)}
    if not rows:
        raise InputError(
            f"The run in {quote_value(out)} has no finished case; run `gscompleter evaluate` first."
        )
    for path, row in rows.items():
        if not isinstance(row, dict) or not {"task", "method", "steps", "error"} <= row.keys():
            raise InputError(f"{quote_value(path)} is no row of scores; delete it and run again.")
    return list(rows.values())


def rank_name(order: Iterable[str], name: str) -> tuple[int, str]:
    """Return the sort key of a name in tables: its place in `order`, unknown ones last."""
    return ([*order, name].index(name), name)


rank_method = partial(rank_name, METHODS)
rank_stage = partial(rank_name, STAGE_ORDER)


def summarize_run(rows: Sequence[RunRow]) -> RunSummary:
    """Collect the rows of the tasks that all methods finished, for a fair comparison."""
    rows = sorted(rows, key=lambda row: (row["task"]["name"], rank_method(row["method"])))
    by_pair = {(row["task"]["name"], row["method"]): row for row in rows}
    methods = tuple(sorted({method for _, method in by_pair}, key=rank_method))
    tasks = tuple(dict.fromkeys(task for task, _ in by_pair))
    finished = {pair: row for pair, row in by_pair.items() if row["error"] is None}
    # A method that failed at hard cases would otherwise gain by its failures.
    common = tuple(task for task in tasks if all((task, method) in finished for method in methods))
    sequences: dict[str, dict[str, Sequence[StepRow]]] = {}
    for (task, method), row in by_pair.items():
        if len(row["task"]["targets"]) > 1:
            sequences.setdefault(task, {})[method] = row["steps"]
    return RunSummary(
        methods=methods,
        tasks=tasks,
        common_tasks=common,
        rows={method: tuple(finished[task, method] for task in common) for method in methods},
        sequences=sequences,
        finished=Counter(method for _, method in finished),
        failures=tuple(
            (*pair, row["error"]) for pair, row in by_pair.items() if row["error"] is not None
        ),
    )


def write_tables(out: Path, with_fid: bool = False) -> RunSummary:
    """Write tables.md, tables.tex, tables.json and timings.md of a run; FID takes longer."""
    rows = read_run_rows(out)
    facts = read_run_facts(out, rows)
    summary = summarize_run(rows)
    fids: Fids = compute_fids(out, summary) if with_fid else "not requested."
    texts = {
        "tables.md": format_score_markdown(summary, fids, facts),
        "tables.tex": format_score_latex(summary, facts),
        "tables.json": json.dumps(collect_score_content(summary, fids, facts), indent=1) + "\n",
        "timings.md": format_timing_markdown(summary, facts),
    }
    for name, text in texts.items():
        with replace_file(out / name) as file:
            file.write(encode_text(text))
    return summary


def compute_fids(out: Path, summary: RunSummary) -> Fids:
    """Compute the FID of each method at the targets against the photographs."""
    steps = [
        (get_task_folder(out, row["task"]["name"]), number)
        for row in summary.rows[summary.methods[0]]
        for number in range(1, len(row["steps"]) + 1)
    ]
    values = {}
    try:
        # The photographs are read once, and compared with the images of each method.
        truths = [read_image(get_truth_path(folder, number)) for folder, number in steps]
        for method in summary.methods:
            paths = [get_step_path(folder, method, n).with_suffix(".png") for folder, n in steps]
            values[method] = compute_fid([read_image(path) for path in paths], truths)
    except InputError as error:
        return str(error)
    return values


def format_score(value: float | None, digits: int) -> str:
    """Format a number, with a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def format_score_cells(summary: RunSummary, columns: Sequence[Column]) -> list[list[str]]:
    """Format a table of scores, one row per method; a number of tasks other than all is added."""

    def format_cell(method: str, column: Column) -> str:
        # A method has as many values as common tasks; if fewer, their number stands beside.
        value, count = summary.compute_cell(method, column)
        number = format_score(value, column.digits)
        return number if count in (0, len(summary.common_tasks)) else f"{number} ({count})"

    return [[m, *(format_cell(m, column) for column in columns)] for m in summary.methods]


def format_score_tables(
    summary: RunSummary, write: Callable[[Sequence[str], Sequence[Sequence[str]]], str]
) -> dict[str, str]:
    """Format the tables of scores that have a value, by title."""
    return {
        title: write(["method", *(c.title for c in columns)], format_score_cells(summary, columns))
        for title, columns in summary.groups.items()
    }


def format_markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table with numbers aligned to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def format_latex(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a LaTeX table with booktabs; cells may hold commands."""
    title, *body = (
        " & ".join(cell.translate(LATEX_SIGNS) for cell in row) + r" \\" for row in (head, *rows)
    )
    begin = rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}"
    lines = [begin, r"\toprule", title, r"\midrule", *body]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def format_score_latex(summary: RunSummary, facts: RunFacts) -> str:
    """Format the tables of scores for LaTeX."""
    scope = f"{len(summary.common_tasks)} of {len(summary.tasks)}"
    blocks = [
        f"% {spell_greek(facts.sentence)}",
        f"% Over the {scope} cases that all methods finished.",
    ]
    blocks += [f"% {note}" for note in summary.notes]
    return "\n".join([*blocks, *format_score_tables(summary, format_latex).values()]) + "\n"


def format_score_markdown(summary: RunSummary, fids: Fids, facts: RunFacts) -> str:
    """Format scores, notes, failures and the steps of sequences."""
    tables = format_score_tables(summary, format_markdown)
    present = {column.key for column in summary.columns}
    scope = (
        f"Means over the {len(summary.common_tasks)} of {len(summary.tasks)} cases that all "
        "methods finished; of a sequence, means over its steps come first. A number in brackets "
        "is the number of cases with the score, if some have none.\n"
    )
    parts = [
        f"{facts.sentence}\n",
        scope,
        *(f"### {title}\n\n{table}" for title, table in tables.items()),
    ]
    parts += [f"{note}\n" for note in summary.notes]
    if present:  # else no case was finished by all methods, which no package mends
        parts += [f"{note}\n" for key, note in ABSENT_NOTES.items() if key not in present]
    parts.append(format_fid_markdown(summary, fids))
    if summary.failures:
        # A bar in a message would end the cell.
        rows = [[cell.replace("|", "\\|") for cell in failure] for failure in summary.failures]
        parts.append("### Failed\n\n" + format_markdown(["case", "method", "reason"], rows))
    head = ["method", "frame", "anchor", "before", "after", "end", "depth scale", "added"]
    for name, by_method in summary.sequences.items():
        rows = [[m, *format_step_cells(step)] for m, steps in by_method.items() for step in steps]
        parts.append(f"### {name}\n\n" + format_markdown(head, rows))
    return "\n".join(parts)


def format_fid_markdown(summary: RunSummary, fids: Fids) -> str:
    """Format the FID of each method, or the reason why there is none."""
    if isinstance(fids, str):
        return f"FID: {fids}\n"
    rows = [[method, f"{value:.2f}"] for method, value in fids.items()]
    note = "At the targets, against their photographs; FID is biased for few images."
    return f"### FID\n\n{note}\n\n" + format_markdown(["method", "FID"], rows)


def format_step_cells(step: StepRow) -> list[str]:
    """Format a step as cells of a table."""
    numbers = [PSNR_BEFORE.get_value(step), PSNR.get_value(step), step["psnr_end"]]
    return [
        str(step["frame"]),
        "–" if step["anchor"] is None else str(step["anchor"]),
        *(format_score(number, 2) for number in numbers),
        format_score(step["depth_scale"], 3),
        str(step["added"]),
    ]


def collect_score_content(summary: RunSummary, fids: Fids, facts: RunFacts) -> dict[str, Any]:
    """Return all scores with full precision, for JSON."""
    values: dict[str, float] = {} if isinstance(fids, str) else fids
    reason = fids if isinstance(fids, str) else None
    columns = [column for group in COLUMN_GROUPS.values() for column in group]
    methods = {}
    for method in summary.methods:
        cells = {column.key: summary.compute_cell(method, column) for column in columns}
        scores = {key: {"value": value, "cases": count} for key, (value, count) in cells.items()}
        methods[method] = {"finished": summary.finished[method], **scores}
    return {
        "made_with": facts.to_json(),
        "cases": len(summary.tasks),
        "common": list(summary.common_tasks),
        "methods": methods,
        "notes": summary.notes,
        "fid": {"values": values, "reason": reason},
        "failures": [
            dict(zip(("case", "method", "reason"), failure, strict=True))
            for failure in summary.failures
        ],
    }


def format_timing_markdown(summary: RunSummary, facts: RunFacts) -> str:
    """Format median seconds by stage and peak memory."""
    seconds = {method: summary.compute_seconds(method) for method in summary.methods}
    stages = sorted({stage for by_stage in seconds.values() for stage in by_stage}, key=rank_stage)
    rows = []
    for method, by_stage in seconds.items():
        peak = summary.find_peak_bytes(method)
        memory = None if peak is None else peak / 2**30
        cells = [*(by_stage.get(stage) for stage in stages), memory]
        rows.append([method, *(format_score(number, 2) for number in cells)])
    return (
        f"{facts.sentence}\n\n"
        f"Median seconds of a step over the {len(summary.common_tasks)} cases that all methods "
        "finished, and peak memory (GiB). The total excludes the reconstruction of the context, "
        "which all methods share.\n\n" + format_markdown(["method", *stages, "memory"], rows)
    )
