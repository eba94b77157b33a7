"""Statistics of measurements, and their tables in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from completions.measure import PROCESS, REST, Sample
from gscompleter.evaluation.tables import format_markdown
from gscompleter.system.timing import STAGES

COLUMNS = (*STAGES, "total", REST, PROCESS)
"""Columns of seconds; stages that did not run are omitted."""


@dataclass(frozen=True)
class Measured:
    """All samples of one case, with their medians."""

    name: str
    samples: Sequence[Sample]

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time by stage."""
        stages = self.samples[0].seconds
        return {stage: median(sample.seconds[stage] for sample in self.samples) for stage in stages}

    @property
    def ratio(self) -> float:
        """Wall time in yardsticks."""
        return median(sample.ratio for sample in self.samples)

    @property
    def cpu(self) -> float:
        """CPU seconds."""
        return median(sample.cpu for sample in self.samples)

    @property
    def peak_bytes(self) -> int:
        """Largest peak memory, or 0 if unknown."""
        return max(sample.peak_bytes or 0 for sample in self.samples)


@dataclass(frozen=True)
class Report:
    """All measurements of one run; bench.json has these fields."""

    machine: Mapping[str, str | int]
    settings: Mapping[str, Any]
    """Seed, repeats, and whether all completions ran in one process."""
    cases: Sequence[Measured]
    growth: Mapping[str, Mapping[int, Measured]]
    """Measurements of the first case by axis and size."""


def fit_exponent(sizes: Sequence[int], values: Sequence[float]) -> float | None:
    """Fit the exponent of a power law by least squares; None for fewer than two sizes."""
    known = [(size, value) for size, value in zip(sizes, values, strict=True) if value > 0]
    if len({size for size, _ in known}) < 2:
        return None
    # value ~ size^p is a line of slope p in logarithms.
    x, y = np.log(np.array(known, dtype=np.float64)).T
    return float(np.polyfit(x, y, 1)[0])


def format_report(report: Report) -> str:
    """Format machine, cases and growth as Markdown."""
    machine = [f"{name.replace('_', ' ')} {value}" for name, value in report.machine.items()]
    units = [sample.yardstick for case in report.cases for sample in case.samples]
    parts = [
        f"{', '.join(machine)}. Medians of {report.settings['repeats']}, of yardsticks also "
        f"smallest to largest; seconds. The yardstick took {median(units):.3f} s.\n",
        *("### Cases\n", format_case_table(report.cases)),
    ]
    for axis, points in report.growth.items():
        parts += [f"### Growth over {axis}\n", format_growth_table(axis, points)]
    return "\n".join(parts)


def format_case_table(cases: Sequence[Measured]) -> str:
    """Format seconds by stage, memory and Gaussians, one row per case."""
    columns = select_columns(cases, COLUMNS)
    rows = []
    for case in cases:
        counts = [case.samples[0].gaussians[key] for key in ("context", "added")]
        rows.append([*format_cells(case, columns), *[f"{count:,}" for count in counts]])
    return format_table("case", columns, rows, "Gaussians", "added")


def format_growth_table(axis: str, points: Mapping[int, Measured]) -> str:
    """Format seconds and memory, one row per size, and the exponents p of value ~ size^p."""
    measured = list(points.values())
    columns = select_columns(measured, COLUMNS)
    rows = [format_cells(point, columns) for point in measured]

    # The last row has an exponent below each column of `format_cells`.
    values = [[point.seconds[column] for point in measured] for column in columns]
    values.append([point.ratio for point in measured])
    values.append([point.cpu for point in measured])
    values.append([float(point.peak_bytes) for point in measured])
    exponents = [fit_exponent(list(points), column) for column in values]
    rows.append(["exponent", *["–" if p is None else f"{p:.2f}" for p in exponents]])
    return format_table(axis, columns, rows)


def format_table(
    first: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *last: str
) -> str:
    """Format rows of `format_cells` with further cells, whose columns are `last`."""
    titles = ("in yardsticks", "CPU seconds", "peak (GB)")
    return format_markdown([first, *columns, *titles, *last], rows)


def select_columns(measured: Sequence[Measured], columns: Sequence[str]) -> list[str]:
    """Select the columns with a positive time."""
    return [
        column
        for column in columns
        if any(point.seconds.get(column, 0.0) > 0 for point in measured)
    ]


def format_cells(measured: Measured, columns: Sequence[str]) -> list[str]:
    """Format the name, the seconds of each column, yardsticks, CPU seconds, and the memory."""
    # Medians of all samples, computed once.
    seconds = measured.seconds
    ratios = [sample.ratio for sample in measured.samples]
    spread = f" ({min(ratios):.1f}–{max(ratios):.1f})" if len(ratios) > 1 else ""
    return [
        measured.name,
        *(f"{seconds[column]:.2f}" if column in seconds else "–" for column in columns),
        f"{measured.ratio:.1f}{spread}",
        f"{measured.cpu:.1f}",
        f"{measured.peak_bytes / 1e9:.2f}" if measured.peak_bytes else "–",
    ]
