"""Tables of a run: scores in one set of files, timings in another.

Score files contain no timings, so an interrupted and resumed run gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError
from gscompleter.evaluation.metrics.fid import fid
from gscompleter.evaluation.store import get_step_path, get_task_folder, get_truth_path
from gscompleter.evaluation.summary import (
    IMAGES,
    PERCEPTUAL,
    Column,
    RunSummary,
    StepRow,
    TableCell,
    get_psnr_after,
    get_psnr_before,
    rank_stage,
    read_rows,
    summarize_run,
)
from gscompleter.io.files import replace_file
from gscompleter.io.image import read_image

LPIPS_MISSING = (
    "LPIPS: weights not available. `gscompleter.evaluation.metrics.lpips.load_lpips()` downloads "
    "them; then "
    "score the run again to add the column.\n"
)
FLIP_MISSING = (
    "FLIP: not installed. Run `pip install 'gscompleter[evaluation]'`; then score the run again to "
    "add the columns.\n"
)


@dataclass(frozen=True)
class FidScores:
    """Fréchet inception distance of each method, or the reason why there is none."""

    values: dict[str, float]
    reason: str | None = None


def write_tables(out: Path, with_fid: bool = False) -> RunSummary:
    """Write tables.md, .tex and .json, and timings.md and .json of a run.

    Args:
        out: Folder of the run.
        with_fid: Also compute the FID of each method against the photographs.

    Raises:
        InputError: if `out` has no run, no rows, or a damaged one.
    """
    summary = summarize_run(read_rows(out))
    fids = compute_fid_scores(out, summary) if with_fid else FidScores({}, "not requested")
    texts = {
        "tables.md": format_score_markdown(summary, fids),
        "tables.tex": format_score_latex(summary),
        "tables.json": _serialize_json(collect_score_content(summary, fids)),
        "timings.md": format_timing_markdown(summary),
        "timings.json": _serialize_json(collect_timing_content(summary)),
    }
    for name, text in texts.items():
        with replace_file(out / name) as file:
            file.write(text.encode())
    return summary


def compute_fid_scores(out: Path, summary: RunSummary) -> FidScores:
    """Compute the FID of each method at the targets against the photographs."""
    steps = [
        (get_task_folder(out, row["task"]["name"]), number)
        for row in summary.rows[summary.methods[0]]
        for number in range(1, len(row["steps"]) + 1)
    ]
    try:
        truths = [read_image(get_truth_path(folder, number)) for folder, number in steps]
        values = {}
        for method in summary.methods:
            paths = [get_step_path(folder, method, n).with_suffix(".png") for folder, n in steps]
            values[method] = fid([read_image(path) for path in paths], truths)
    except InputError as error:
        return FidScores({}, f"not available ({error})")
    return FidScores(values)


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


def format_markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table with numbers aligned to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def format_score_markdown(summary: RunSummary, fids: FidScores) -> str:
    """Format scores, notes, failures and the steps of sequences."""
    parts = [describe_scope(summary)]
    for title, columns in summary.groups.items():
        chosen = summary.find_present_columns(columns)
        if chosen:
            head = ["method", *(column.title for column in chosen)]
            parts.append(
                f"### {title}\n\n" + format_markdown(head, format_score_cells(summary, chosen))
            )
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
    parts += [format_step_markdown(name, steps) for name, steps in summary.sequences.items()]
    return "\n".join(parts)


def describe_scope(summary: RunSummary) -> str:
    """Describe which cases the numbers cover."""
    text = (
        f"Means over the {len(summary.common_tasks)} of {len(summary.tasks)} cases that all "
        "methods "
        "finished. A number in brackets is the number of cases with the score, if some have "
        "none.\n"
    )
    if not summary.sequences:
        return text
    return text + (
        f"They have {summary.num_steps} steps in total: means are over the steps of each case, "
        "then over the cases. A depth scale of 1 is metric; its drift over a sequence is "
        "max(ln s) - min(ln s).\n"
    )


def format_fid_markdown(summary: RunSummary, fids: FidScores) -> str:
    """Format the FID of each method, or the reason why there is none."""
    if fids.reason is not None:
        return f"FID: {fids.reason}.\n"
    rows = [[method, f"{value:.2f}"] for method, value in fids.values.items()]
    return (
        f"### FID\n\n{summary.num_steps} images against as many photographs; FID is biased for "
        "few images.\n\n" + format_markdown(["method", "FID"], rows)
    )


def format_gain_markdown(summary: RunSummary) -> str:
    """Format the ΔPSNR by distance from the known views."""
    counts = {gap: max(c.count for c in cells.values()) for gap, cells in summary.gains.items()}
    head = ["method", *(f"{gap} ({counts[gap]})" for gap in summary.gains)]
    gains = summary.gains.items()
    rows = [
        [method, *(format_cell(cells[method], 2, counts[gap]) for gap, cells in gains)]
        for method in summary.methods
    ]
    return (
        "### ΔPSNR by distance\n\nMean ΔPSNR in dB by the frames between the target and the "
        "nearest context frame (k of n-k), with the number of cases.\n\n"
        + format_markdown(head, rows)
    )


def format_step_markdown(name: str, by_method: Mapping[str, Sequence[StepRow]]) -> str:
    """Format the steps of a task."""
    head = ["method", "frame", "anchor", "before", "after", "end", "depth scale", "added"]
    rows = [
        [method, *format_step_cells(step)] for method, steps in by_method.items() for step in steps
    ]
    return f"### {name}\n\n" + format_markdown(head, rows)


def format_step_cells(step: StepRow) -> list[str]:
    """Format a step as cells of a table."""
    numbers = [get_psnr_before(step), get_psnr_after(step), step["psnr_end"]]
    return [
        str(step["frame"]),
        "–" if step["anchor"] is None else str(step["anchor"]),
        *(format_score(number, 2) for number in numbers),
        format_score(step["depth_scale"], 3),
        str(step["added"]),
    ]


def format_score_latex(summary: RunSummary) -> str:
    """Format the tables of scores for LaTeX with booktabs."""
    blocks = [
        f"% Over the {len(summary.common_tasks)} of {len(summary.tasks)} cases that all methods "
        "finished."
    ]
    blocks += [f"% {note}" for note in summary.notes]
    for group in summary.groups.values():
        columns = summary.find_present_columns(group)
        if columns:
            blocks.append(_format_tabular(summary, columns))
    return "\n".join(blocks) + "\n"


def _format_tabular(summary: RunSummary, columns: Sequence[Column]) -> str:
    lines = [
        rf"\begin{{tabular}}{{l{'r' * len(columns)}}}",
        r"\toprule",
        " & ".join(["method", *(column.title for column in columns)]) + r" \\",
        r"\midrule",
    ]
    for row in format_score_cells(summary, columns):
        lines.append(" & ".join(row).replace("_", r"\_").replace("–", "--") + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def collect_score_content(summary: RunSummary, fids: FidScores) -> dict[str, Any]:
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
        "fid": {"values": fids.values, "reason": fids.reason},
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
    stages = sorted(
        {s for m in summary.methods for s in summary.compute_seconds(m)}, key=rank_stage
    )
    rows = []
    for method in summary.methods:
        seconds, peak = summary.compute_seconds(method), summary.find_peak_bytes(method)
        memory = None if peak is None else peak / 2**30
        rows.append(
            [
                method,
                *(format_score(seconds.get(stage), 2) for stage in stages),
                format_score(memory, 2),
            ]
        )
    return (
        f"Median seconds of a step over the {len(summary.common_tasks)} cases that all methods "
        "finished, "
        "and peak memory (GiB). The total excludes the reconstruction of the context, which all "
        "methods share.\n\n" + format_markdown(["method", *stages, "memory"], rows)
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


def _serialize_json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=1) + "\n"
