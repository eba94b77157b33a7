"""Statistics of measurements as JSON, tables in Markdown and curves."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gscompleter.apps.bench.measure import OWN, PROCESS, REST, Sample
from gscompleter.evaluation.plots import create_plot_figure, get_curve_style, write_figure
from gscompleter.evaluation.tables import format_markdown
from gscompleter.timing import STAGES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = (*STAGES, "total", REST, PROCESS)
"""Columns of the seconds of a case; stages that did not run are omitted."""
METHOD_COLUMNS = ("generate", "lift", "register", "integrate", "optimize", OWN)
SHARED_COLUMNS = "in yardsticks", "peak (GB)"
"""Columns of all tables after the seconds."""
CURVES = (*STAGES, REST, PROCESS)


@dataclass(frozen=True)
class Spread:
    """Statistics of several measurements of one quantity."""

    median: float
    low: float
    high: float

    @staticmethod
    def from_values(values: Sequence[float]) -> Spread:
        """Compute the statistics of values."""
        return Spread(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Measured:
    """All samples of one case or method, with their statistics."""

    name: str
    gaussians: Mapping[str, int]
    """Numbers of Gaussians; the seed makes all samples equal."""
    peak_bytes: int | None
    """Largest peak memory, or None if unknown."""
    seconds: Mapping[str, Spread]
    """Wall time by stage."""
    ratios: Mapping[str, Spread]
    """Wall time by stage, in yardsticks."""
    samples: Sequence[Sample]


def summarize(name: str, samples: Sequence[Sample]) -> Measured:
    """Compute the statistics of samples."""
    known = [sample.peak_bytes for sample in samples if sample.peak_bytes is not None]
    return Measured(
        name,
        samples[0].gaussians,
        max(known, default=None),
        summarize_stages([sample.seconds for sample in samples]),
        summarize_stages([sample.ratios for sample in samples]),
        samples,
    )


def summarize_stages(values: Sequence[Mapping[str, float]]) -> dict[str, Spread]:
    """Compute the statistics of each stage."""
    return {stage: Spread.from_values([v[stage] for v in values]) for stage in values[0]}


@dataclass(frozen=True)
class Growth:
    """Measurements along an axis."""

    axis: str
    sizes: Sequence[int]
    slopes: Mapping[str, float | None]
    """Exponent p of seconds ~ size^p by stage."""
    memory_slope: float | None
    """Exponent of the peak memory."""
    points: Sequence[Measured]
    """One for each size."""


def fit_growth(axis: str, sizes: Sequence[int], points: Sequence[Measured]) -> Growth:
    """Fit a power law to the medians of each stage."""
    slopes = {stage: fit_exponent(sizes, get_medians(points, stage)) for stage in points[0].seconds}
    memory = fit_exponent(sizes, [float(point.peak_bytes or 0) for point in points])
    return Growth(axis, sizes, slopes, memory, points)


def get_medians(points: Sequence[Measured], stage: str) -> list[float]:
    """Return the median seconds of a stage at each size."""
    return [point.seconds[stage].median for point in points]


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
    yardstick: Spread
    """Seconds of the yardstick over all measurements."""
    cases: Sequence[Measured]
    methods: Sequence[Measured]
    """Measurements on the first target of the first case; ours is the first if present."""
    growth: Sequence[Growth]


def format_report(report: Report) -> str:
    """Format machine, cases, methods and growth as Markdown."""
    parts = [format_machine(report)]
    if report.cases:
        parts += ["### Cases\n", format_case_table(report.cases)]
    if report.methods:
        parts += ["### Methods\n", format_method_table(report.methods)]
    for series in report.growth:
        parts += [f"### Growth over {series.axis}\n", format_growth_table(series)]
    return "\n".join(parts)


def format_machine(report: Report) -> str:
    """Describe the machine and the measurements."""
    machine = [f"{name.replace('_', ' ')} {value}" for name, value in report.machine.items()]
    return (
        f"{', '.join(machine)}. "
        f"Medians (smallest to largest) of {report.settings['repeats']}; seconds. "
        f"The yardstick took {format_spread(report.yardstick)} s.\n"
    )


def format_case_table(cases: Sequence[Measured]) -> str:
    """Format seconds by stage, memory and Gaussians, one row per case."""
    columns = select_columns(cases, COLUMNS)
    rows = [
        [
            *(case.name, *format_cells(case, columns, PROCESS)),
            *(f"{case.gaussians[part]:,}" for part in ("context", "added")),
        ]
        for case in cases
    ]
    return format_markdown(["case", *columns, *SHARED_COLUMNS, "Gaussians", "added"], rows)


def format_method_table(methods: Sequence[Measured]) -> str:
    """Format seconds by stage and the ratio to the first method, one row per method."""
    columns, first = select_columns(methods, METHOD_COLUMNS), methods[0]
    rows = [
        [
            *(method.name, *format_cells(method, columns, OWN)),
            f"{method.ratios[OWN].median / first.ratios[OWN].median:.3g}",
        ]
        for method in methods
    ]
    return format_markdown(["method", *columns, *SHARED_COLUMNS, f"times {first.name}"], rows)


def format_growth_table(series: Growth) -> str:
    """Format seconds by stage, one row per size, with the exponents in the last row."""
    columns = select_columns(series.points, COLUMNS)
    rows = [
        [f"{size:,}", *format_cells(point, columns, PROCESS)]
        for size, point in zip(series.sizes, series.points, strict=True)
    ]
    powers = [*(series.slopes[column] for column in columns), None, series.memory_slope]
    rows.append(["exponent", *("–" if power is None else f"{power:.2f}" for power in powers)])
    return format_markdown([series.axis, *columns, *SHARED_COLUMNS], rows)


def select_columns(found: Sequence[Measured], columns: Sequence[str]) -> list[str]:
    """Select the columns with a positive time."""
    present = {stage for one in found for stage, spent in one.seconds.items() if spent.high > 0}
    return [column for column in columns if column in present]


def format_cells(found: Measured, columns: Sequence[str], whole: str) -> list[str]:
    """Format the seconds of each column, the yardsticks of the stage `whole`, and the memory."""
    seconds = [found.seconds.get(column) for column in columns]
    return [
        *("–" if spread is None else format_spread(spread) for spread in seconds),
        format_spread(found.ratios[whole], 1),
        "–" if found.peak_bytes is None else f"{found.peak_bytes / 1e9:.2f}",
    ]


def format_spread(spread: Spread, digits: int = 2) -> str:
    """Format the median, with the range if there are several values."""
    median = f"{spread.median:.{digits}f}"
    if spread.low == spread.high:
        return median
    return f"{median} ({spread.low:.{digits}f}–{spread.high:.{digits}f})"


def plot_growth(path: Path, growth: Sequence[Growth]) -> Path:
    """Write a PNG with one panel per series; raise PlotsNotAvailable without matplotlib."""
    figure = create_plot_figure(3.2 * len(growth))
    panels = figure.subplots(len(growth), squeeze=False)[:, 0]
    for axes, series in zip(panels, growth, strict=True):
        plot_series(axes, series)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper")
    return write_figure(figure, path)


def plot_series(axes: Axes, series: Growth) -> None:
    """Plot the median seconds of each stage against size, with logarithmic axes."""
    for number, stage in enumerate(CURVES):
        if stage in series.slopes:
            medians, style = get_medians(series.points, stage), get_curve_style(number)
            axes.plot(series.sizes, medians, label=stage, linewidth=1, **style)
    axes.set_xscale("log")
    axes.set_yscale("log")
    found = series.slopes[PROCESS]
    axes.set_xlabel(series.axis if found is None else f"{series.axis} (process: {found:.2f})")
    axes.set_ylabel("seconds")
    axes.grid(alpha=0.3)
