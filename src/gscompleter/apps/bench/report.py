"""Statistics of measurements, and their tables in Markdown."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gscompleter.apps.bench.measure import OWN, PROCESS, REST, Sample
from gscompleter.evaluation.tables import format_markdown
from gscompleter.timing import STAGES

CASE_COLUMNS = (*STAGES, "total", REST, PROCESS)
METHOD_COLUMNS = ("generate", "lift", "register", "integrate", "optimize", OWN)
"""Columns of seconds; stages that did not run are omitted."""
PEAK = "peak"
"""Key of the exponent of the peak memory."""


@dataclass(frozen=True)
class Measured:
    """All samples of one case or method, with medians."""

    name: str
    seconds: Mapping[str, float]
    """Wall time by stage."""
    ratio: float
    """Wall time in yardsticks."""
    peak_bytes: int | None
    """Largest peak memory, or None if unknown."""
    gaussians: Mapping[str, int]
    """Numbers of Gaussians; the seed makes all samples equal."""
    samples: Sequence[Sample]


def summarize(name: str, samples: Sequence[Sample]) -> Measured:
    """Compute the medians of samples."""
    return Measured(
        name,
        {
            stage: statistics.median([sample.seconds[stage] for sample in samples])
            for stage in samples[0].seconds
        },
        statistics.median([sample.ratio for sample in samples]),
        max((s.peak_bytes for s in samples if s.peak_bytes is not None), default=None),
        samples[0].gaussians,
        samples,
    )


@dataclass(frozen=True)
class Growth:
    """Measurements along an axis."""

    axis: str
    exponents: Mapping[str, float | None]
    """Exponent p of seconds ~ size^p by stage, and of the peak memory."""
    points: Mapping[int, Measured]
    """Measurements by size."""


def fit_growth(axis: str, points: Mapping[int, Measured]) -> Growth:
    """Fit a power law to the medians of each stage."""
    found, sizes = [*points.values()], [*points]
    exponents = {
        stage: fit_exponent(sizes, [point.seconds[stage] for point in found])
        for stage in found[0].seconds
    }
    exponents[PEAK] = fit_exponent(sizes, [float(point.peak_bytes or 0) for point in found])
    return Growth(axis, exponents, points)


def fit_exponent(sizes: Sequence[int], values: Sequence[float]) -> float | None:
    """Fit the exponent of a power law by least squares; None for fewer than two sizes."""
    known = [(size, value) for size, value in zip(sizes, values, strict=True) if value > 0]
    if len({size for size, _ in known}) < 2:
        return None
    x, y = np.log(np.array(known, dtype=np.float64)).T
    return float(np.polyfit(x, y, 1)[0])


@dataclass(frozen=True)
class Report:
    """All measurements of one run; bench.json has these fields."""

    machine: Mapping[str, str | int]
    settings: Mapping[str, Any]
    """Seed, repeats, and maximum number of iterations of the baselines."""
    yardstick: float
    """Median seconds of the yardstick."""
    cases: Sequence[Measured]
    methods: Sequence[Measured]
    """Measurements on the first target of the first case; ours is the first if present."""
    growth: Sequence[Growth]


def format_report(report: Report) -> str:
    """Format machine, cases, methods and growth as Markdown."""
    machine = [f"{name.replace('_', ' ')} {value}" for name, value in report.machine.items()]
    parts = [
        f"{', '.join(machine)}. Medians of {report.settings['repeats']}, of yardsticks also "
        f"smallest to largest; seconds. The yardstick took {report.yardstick:.3f} s.\n"
    ]
    if report.cases:
        parts += ["### Cases\n", format_case_table(report.cases)]
    if report.methods:
        parts += ["### Methods\n", format_method_table(report.methods)]
    for series in report.growth:
        parts += [f"### Growth over {series.axis}\n", format_growth_table(series)]
    return "\n".join(parts)


def format_case_table(cases: Sequence[Measured]) -> str:
    """Format seconds by stage, memory and Gaussians, one row per case."""
    columns = select_columns(cases, CASE_COLUMNS)
    rows = [
        [*format_cells(case, columns), *(f"{case.gaussians[k]:,}" for k in ("context", "added"))]
        for case in cases
    ]
    return format_table("case", columns, rows, "Gaussians", "added")


def format_method_table(methods: Sequence[Measured]) -> str:
    """Format seconds by stage, and multiples of the first method, one row per method."""
    columns, first = select_columns(methods, METHOD_COLUMNS), methods[0]
    rows = [
        [*format_cells(method, columns), f"{method.ratio / first.ratio:.3g}"] for method in methods
    ]
    return format_table("method", columns, rows, f"times {first.name}")


def format_growth_table(series: Growth) -> str:
    """Format seconds and memory, one row per size, and then the exponents."""
    points = [*series.points.values()]
    columns = select_columns(points, CASE_COLUMNS)
    powers = [*(series.exponents[column] for column in columns), None, series.exponents[PEAK]]
    last = ["exponent", *("–" if power is None else f"{power:.2f}" for power in powers)]
    rows = [format_cells(point, columns) for point in points]
    return format_table(series.axis, columns, [*rows, last])


def format_table(
    first: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *last: str
) -> str:
    """Format rows of `format_cells` with further cells, whose columns are `last`."""
    return format_markdown([first, *columns, "in yardsticks", "peak (GB)", *last], rows)


def select_columns(found: Sequence[Measured], columns: Sequence[str]) -> list[str]:
    """Select the columns with a positive time."""
    return [c for c in columns if any(one.seconds.get(c, 0.0) > 0 for one in found)]


def format_cells(found: Measured, columns: Sequence[str]) -> list[str]:
    """Format the name, the seconds of each column, the yardsticks, and the memory."""
    ratios = [sample.ratio for sample in found.samples]
    spread = f" ({min(ratios):.1f}–{max(ratios):.1f})" if len(ratios) > 1 else ""
    return [
        found.name,
        *(f"{found.seconds[c]:.2f}" if c in found.seconds else "–" for c in columns),
        f"{found.ratio:.1f}{spread}",
        "–" if found.peak_bytes is None else f"{found.peak_bytes / 1e9:.2f}",
    ]
