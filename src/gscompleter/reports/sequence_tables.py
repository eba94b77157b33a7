"""Tables of the sequences of a run: scores in one set of files, timings in another.

As with the tables of cases, those of scores depend on nothing but scores, so that a run that was
stopped and went on gives the same bytes as one that was not.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError
from gscompleter.io.files import replacing
from gscompleter.reports.tables import markdown, place_of
from gscompleter.runs.methods import METHODS
from gscompleter.runs.sequences import scale_drift
from gscompleter.runs.store import SEQUENCES, read_json

Row = dict[str, Any]
"""What `evaluate_sequences` writes for a sequence and a method."""

Steps = Sequence[dict[str, Any]]
"""The steps of a row."""


@dataclass(frozen=True)
class Measure:
    """One number about the steps of a sequence."""

    key: str
    title: str
    digits: int
    of: Callable[[Steps], float | None]
    """None where it is not known."""


def _mean(key: str) -> Callable[[Steps], float | None]:
    def mean(steps: Steps) -> float | None:
        known = [step[key] for step in steps if step[key] is not None]
        return statistics.fmean(known) if known else None

    return mean


MEASURES = (
    Measure("psnr_before", "PSNR before", 2, _mean("psnr_before")),
    Measure("psnr_after", "PSNR after", 2, _mean("psnr_after")),
    Measure(
        "gain",
        "gain",
        2,
        lambda steps: statistics.fmean(s["psnr_after"] - s["psnr_before"] for s in steps),
    ),
    Measure("psnr_end", "PSNR at the end", 2, _mean("psnr_end")),
    Measure("depth_scale", "depth scale", 3, _mean("depth_scale")),
    Measure("scale_drift", "scale drift", 3, lambda s: scale_drift([x["depth_scale"] for x in s])),
)
"""PSNR in dB, at the target of each step; all but the drift are means over the steps."""


@dataclass(frozen=True)
class SequenceSummary:
    """All that the tables show."""

    methods: tuple[str, ...]
    steps: dict[str, dict[str, Steps]]
    """By sequence and method; as far as a method came where it failed."""
    common: tuple[str, ...]
    """Names of the sequences that all methods finished."""
    failures: tuple[tuple[str, str, int, str], ...]
    """Sequence, method, steps before it, reason."""


def sequence_tables(out: Path) -> SequenceSummary | None:
    """Write sequences.md and .json, and sequence_timings.md and .json, from the rows below `out`.

    Where no sequence has a row, nothing is written, and None comes back.

    Raises:
        InputError: where a row is damaged, or a file cannot be written.
    """
    summary = read_sequences(out)
    if summary is None:
        return None
    texts = {
        "sequences.md": score_markdown(summary),
        "sequences.json": score_json(summary),
        "sequence_timings.md": timing_markdown(summary),
        "sequence_timings.json": timing_json(summary),
    }
    for name, text in texts.items():
        with replacing(out / name) as file:
            file.write(text.encode())
    return summary


def read_sequences(out: Path) -> SequenceSummary | None:
    """What there is about sequences below `out`; None where that is nothing.

    Raises:
        InputError: where a row is damaged.
    """
    rows = [_read_row(path) for path in sorted((out / SEQUENCES).glob("*/*.json"))]
    if not rows:
        return None
    methods = tuple(sorted({row["method"] for row in rows}, key=place_of))
    rows.sort(key=lambda row: (row["sequence"]["name"], *place_of(row["method"])))
    steps: dict[str, dict[str, Steps]] = {row["sequence"]["name"]: {} for row in rows}
    for row in rows:
        steps[row["sequence"]["name"]][row["method"]] = row["steps"]
    failed = [row for row in rows if row["error"] is not None]
    done = {(row["sequence"]["name"], row["method"]) for row in rows if row["error"] is None}
    return SequenceSummary(
        methods,
        steps,
        tuple(name for name in steps if all((name, method) in done for method in methods)),
        tuple((r["sequence"]["name"], r["method"], len(r["steps"]), r["error"]) for r in failed),
    )


def _read_row(path: Path) -> Row:
    row = read_json(path)
    try:
        whole = row["method"] in METHODS and isinstance(row["steps"], list)
        row["sequence"]["name"], row["error"]
    except (KeyError, TypeError):
        whole = False
    if not whole:
        raise InputError(f"{path} is no row of a sequence; delete it and run again.")
    return dict(row)


def measured(summary: SequenceSummary, method: str, measure: Measure) -> float | None:
    """Mean of a measure over the sequences that all methods finished and that have it."""
    values = [measure.of(summary.steps[name][method]) for name in summary.common]
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def overview(summary: SequenceSummary) -> str:
    """A row per method, over the sequences that all methods finished."""
    count = sum(len(summary.steps[name][summary.methods[0]]) for name in summary.common)
    rows = [
        [method, *(_shown(measured(summary, method, m), m.digits) for m in MEASURES)]
        for method in summary.methods
    ]
    return (
        f"Over the {len(summary.common)} of {len(summary.steps)} sequences that all methods "
        f"finished, {count} steps in all: means over the steps of each, then over these. A depth "
        "scale of 1 is metric; its drift over a sequence is max(ln s) - min(ln s).\n\n"
        + markdown(["method", *(measure.title for measure in MEASURES)], rows)
    )


def score_markdown(summary: SequenceSummary) -> str:
    """The overview, what failed, and each step of each sequence."""
    text = overview(summary)
    if summary.failures:
        rows = [
            [name, method, str(steps), reason.replace("|", "\\|")]
            for name, method, steps, reason in summary.failures
        ]
        text += "\nFailed:\n\n" + markdown(["sequence", "method", "steps", "reason"], rows)
    for name, by_method in summary.steps.items():
        rows = [
            [method, *_step_cells(step)] for method, steps in by_method.items() for step in steps
        ]
        head = ["method", "frame", "anchor", "before", "after", "end", "depth scale", "added"]
        text += f"\n{name}:\n\n" + markdown(head, rows)
    return text


def _step_cells(step: dict[str, Any]) -> list[str]:
    anchor = "–" if step["anchor"] is None else str(step["anchor"])
    numbers = [_shown(step[key], 2) for key in ("psnr_before", "psnr_after", "psnr_end")]
    scale = _shown(step["depth_scale"], 3)
    return [str(step["frame"]), anchor, *numbers, scale, str(step["added"])]


def _shown(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def score_json(summary: SequenceSummary) -> str:
    """The same with all digits."""
    methods = {
        method: {measure.key: measured(summary, method, measure) for measure in MEASURES}
        for method in summary.methods
    }
    steps = {
        name: {
            method: [{key: step[key] for key in step if key != "seconds"} for step in steps]
            for method, steps in by_method.items()
        }
        for name, by_method in summary.steps.items()
    }
    failures = [
        {"sequence": name, "method": method, "steps": count, "reason": reason}
        for name, method, count, reason in summary.failures
    ]
    content = {
        "sequences": len(summary.steps),
        "common": list(summary.common),
        "methods": methods,
        "steps": steps,
        "failures": failures,
    }
    return json.dumps(content, indent=1) + "\n"


def seconds_of(summary: SequenceSummary, method: str) -> list[dict[str, float]]:
    """Seconds by stage of each step of the sequences that all methods finished."""
    return [step["seconds"] for name in summary.common for step in summary.steps[name][method]]


def timing_markdown(summary: SequenceSummary) -> str:
    """Seconds per step: mean and longest of each method."""
    rows = []
    for method in summary.methods:
        totals = [seconds["total"] for seconds in seconds_of(summary, method)]
        numbers = [statistics.fmean(totals), max(totals)] if totals else [None, None]
        rows.append([method, *(_shown(number, 2) for number in numbers)])
    return (
        f"Seconds per step over the {len(summary.common)} sequences that all methods finished.\n\n"
        + markdown(["method", "mean", "longest"], rows)
    )


def timing_json(summary: SequenceSummary) -> str:
    """By method the mean and the longest, and by sequence and method each step by stage."""
    methods = {}
    for method in summary.methods:
        totals = [seconds["total"] for seconds in seconds_of(summary, method)]
        mean = statistics.fmean(totals) if totals else None
        methods[method] = {"mean": mean, "longest": max(totals, default=None)}
    steps = {
        name: {method: [step["seconds"] for step in steps] for method, steps in by_method.items()}
        for name, by_method in summary.steps.items()
    }
    return json.dumps({"methods": methods, "steps": steps}, indent=1) + "\n"
