"""Tables of a run: scores in one set of files, timings in another.

Score files contain no timings, so an interrupted and resumed run gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError
from gscompleter.evaluation.metrics.fid import fid
from gscompleter.evaluation.store import get_step_path, get_task_folder, get_truth_path
from gscompleter.evaluation.summary import (
    IMAGES,
    PERCEPTUAL,
    PSNR,
    PSNR_BEFORE,
    Column,
    RunSummary,
    StepRow,
    TableCell,
    rank_stage,
    read_rows,
    summarize_run,
)
from gscompleter.io.files import replace_file
from gscompleter.io.image import read_image

LPIPS_MISSING = (
    "LPIPS: weights not available. `gscompleter.evaluation.metrics.lpips.load_lpips()` downloads "
    "them; then score the run again to add the column.\n"
)
FLIP_MISSING = (
    "FLIP: not installed. Run `pip install 'gscompleter[evaluation]'`; then score the run again to "
    "add the columns.\n"
)

Fids = dict[str, Any]
"""`values`: the Fréchet inception distance of each method; `reason`: why there is none."""


def write_tables(out: Path, with_fid: bool = False) -> RunSummary:
    """Write tables.md, .tex and .json, and timings.md and .json of a run.

    Args:
        out: Folder of the run.
        with_fid: Also compute the FID of each method against the photographs.

    Raises:
        InputError: if `out` has no run, no rows, or a damaged one.
    """
    summary = summarize_run(read_rows(out))
    fids = {"values": {}, "reason": "not requested"}
    if with_fid:
        fids = compute_fids(out, summary)
    texts = {
        "tables.md": format_score_markdown(summary, fids),
        "tables.tex": format_score_latex(summary),
        "tables.json": json.dumps(collect_score_content(summary, fids), indent=1) + "\n",
        "timings.md": format_timing_markdown(summary),
        "timings.json": json.dumps(collect_timing_content(summary), indent=1) + "\n",
    }
    for name, text in texts.items():
        with replace_file(out / name) as file:
            file.write(text.encode())
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
        truths = [read_image(get_truth_path(folder, number)) for folder, number in steps]
        for method in summary.methods:
            paths = [get_step_path(folder, method, n).with_suffix(".png") for folder, n in steps]
            values[method] = fid([read_image(path) for path in paths], truths)
    except InputError as error:
        return {"values": {}, "reason": f"not available ({error})"}
    return {"values": values, "reason": None}


def format_score(value: float | None, digits: int) -> str:
    """Format a number, with a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def format_cell(cell: TableCell, digits: int, count: int) -> str:
    """Format an entry, with its number of tasks if that is not `count`."""
    number = format_score(cell.value, digits)
    return number if cell.count in (0, count) else f"{number} ({cell.count})"


def format_score_cells(summary: RunSummary, columns: Sequence[Column]) -> list[list[str]]:
    """Format a table of scores, one row per method."""
    n = len(summary.common_tasks)
    return [
        [method, *(format_cell(summary.compute_cell(method, c), c.digits, n) for c in columns)]
        for method in summary.methods
    ]


def format_score_tables(
    summary: RunSummary, write: Callable[[Sequence[str], Sequence[Sequence[str]]], str]
) -> dict[str, str]:
    """Format the tables of scores that have a value, by title."""
    groups = {t: summary.find_present_columns(columns) for t, columns in summary.groups.items()}
    return {
        title: write(["method", *(c.title for c in columns)], format_score_cells(summary, columns))
        for title, columns in groups.items()
        if columns
    }


def format_markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table with numbers aligned to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def format_latex(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a LaTeX table with booktabs."""
    body = [" & ".join(row).replace("_", r"\_").replace("–", "--") + r" \\" for row in rows]
    begin = rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}"
    lines = [begin, r"\toprule", " & ".join(head) + r" \\", r"\midrule", *body]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def format_score_latex(summary: RunSummary) -> str:
    """Format the tables of scores for LaTeX."""
    scope = f"{len(summary.common_tasks)} of {len(summary.tasks)}"
    blocks = [f"% Over the {scope} cases that all methods finished."]
    blocks += [f"% {note}" for note in summary.notes]
    return "\n".join([*blocks, *format_score_tables(summary, format_latex).values()]) + "\n"


def format_score_markdown(summary: RunSummary, fids: Fids) -> str:
    """Format scores, notes, failures and the steps of sequences."""
    tables = format_score_tables(summary, format_markdown)
    parts = [describe_scope(summary), *(f"### {t}\n\n{table}" for t, table in tables.items())]
    parts += [f"{note}\n" for note in summary.notes]
    if not any(column.key.startswith("lpips") for column in summary.find_present_columns(IMAGES)):
        parts.append(LPIPS_MISSING)
    if not any(column.key.endswith("flip") for column in summary.find_present_columns(PERCEPTUAL)):
        parts.append(FLIP_MISSING)
    parts.append(format_fid_markdown(summary, fids))
    if len(summary.gains) > 1:
        parts.append(format_gain_markdown(summary))
    if summary.failures:
        rows = [[cell.replace("|", "\\|") for cell in failure] for failure in summary.failures]
        parts.append("### Failed\n\n" + format_markdown(["case", "method", "reason"], rows))
    head = ["method", "frame", "anchor", "before", "after", "end", "depth scale", "added"]
    for name, by_method in summary.sequences.items():
        rows = [[m, *format_step_cells(step)] for m, steps in by_method.items() for step in steps]
        parts.append(f"### {name}\n\n" + format_markdown(head, rows))
    return "\n".join(parts)


def describe_scope(summary: RunSummary) -> str:
    """Describe which cases the numbers cover."""
    text = (
        f"Means over the {len(summary.common_tasks)} of {len(summary.tasks)} cases that all "
        "methods finished. A number in brackets is the number of cases with the score, if some "
        "have none.\n"
    )
    if not summary.sequences:
        return text
    return text + (
        f"They have {summary.num_steps} steps in total: means are over the steps of each case, "
        "then over the cases. A depth scale of 1 is metric; its drift over a sequence is "
        "max(ln s) - min(ln s).\n"
    )


def format_fid_markdown(summary: RunSummary, fids: Fids) -> str:
    """Format the FID of each method, or the reason why there is none."""
    if fids["reason"] is not None:
        return f"FID: {fids['reason']}.\n"
    rows = [[method, f"{value:.2f}"] for method, value in fids["values"].items()]
    return (
        f"### FID\n\n{summary.num_steps} images against as many photographs; FID is biased for "
        "few images.\n\n" + format_markdown(["method", "FID"], rows)
    )


def format_gain_markdown(summary: RunSummary) -> str:
    """Format the ΔPSNR by distance from the known views."""
    counts = {gap: max(c.count for c in cells.values()) for gap, cells in summary.gains.items()}
    head = ["method", *(f"{gap} ({count})" for gap, count in counts.items())]
    rows = [
        [m, *(format_cell(cells[m], 2, counts[gap]) for gap, cells in summary.gains.items())]
        for m in summary.methods
    ]
    return (
        "### ΔPSNR by distance\n\nMean ΔPSNR in dB by the frames between the target and the "
        "nearest context frame (k of n-k), with the number of cases.\n\n"
        + format_markdown(head, rows)
    )


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


def collect_score_content(summary: RunSummary, fids: Fids) -> dict[str, Any]:
    """Return all scores with full precision, for JSON."""
    content: dict[str, Any] = {
        "cases": len(summary.tasks),
        "common": list(summary.common_tasks),
        "methods": {
            method: {
                "finished": summary.finished[method],
                **{
                    column.key: {"value": cell.value, "cases": cell.count}
                    for column in summary.columns
                    for cell in [summary.compute_cell(method, column)]
                },
            }
            for method in summary.methods
        },
        "gain_by_distance": {
            str(gap): {method: cell.value for method, cell in cells.items()}
            for gap, cells in summary.gains.items()
        },
        "notes": summary.notes,
        "fid": fids,
        "failures": [
            dict(zip(("case", "method", "reason"), failure, strict=True))
            for failure in summary.failures
        ],
    }
    if summary.sequences:
        content["steps"] = _collect_steps(summary, drop_cost)
    return content


def drop_cost(step: StepRow) -> StepRow:
    """Drop the values of a step that differ from run to run."""
    return {key: step[key] for key in step if key not in ("seconds", "peak_bytes")}


def _collect_steps(
    summary: RunSummary, get_value: Callable[[StepRow], Any]
) -> dict[str, dict[str, list[Any]]]:
    return {
        name: {method: [get_value(step) for step in steps] for method, steps in by_method.items()}
        for name, by_method in summary.sequences.items()
    }


def format_timing_markdown(summary: RunSummary) -> str:
    """Format median seconds by stage and peak memory."""
    seconds = {method: summary.compute_seconds(method) for method in summary.methods}
    stages = sorted({stage for found in seconds.values() for stage in found}, key=rank_stage)
    rows = []
    for method, found in seconds.items():
        peak = summary.find_peak_bytes(method)
        memory = None if peak is None else peak / 2**30
        cells = [*(found.get(stage) for stage in stages), memory]
        rows.append([method, *(format_score(number, 2) for number in cells)])
    return (
        f"Median seconds of a step over the {len(summary.common_tasks)} cases that all methods "
        "finished, and peak memory (GiB). The total excludes the reconstruction of the context, "
        "which all methods share.\n\n" + format_markdown(["method", *stages, "memory"], rows)
    )


def collect_timing_content(summary: RunSummary) -> dict[str, Any]:
    """Return all timings with full precision, for JSON, and the seconds of sequence steps."""
    content: dict[str, Any] = {
        method: {
            "seconds": summary.compute_seconds(method),
            "peak_bytes": summary.find_peak_bytes(method),
        }
        for method in summary.methods
    }
    if summary.sequences:
        content["steps"] = _collect_steps(summary, lambda step: step["seconds"])
    return content
