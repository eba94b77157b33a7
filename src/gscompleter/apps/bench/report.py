"""Measurements as tables in Markdown and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from gscompleter.apps.bench.comparison import OWN
from gscompleter.apps.bench.completions import PROCESS, REST
from gscompleter.apps.bench.growth import Growth
from gscompleter.apps.bench.samples import SampleSet, Spread
from gscompleter.evaluation.tables import format_markdown
from gscompleter.timing import STAGES

COLUMNS = (*STAGES, "total", REST, PROCESS)
"""Columns of the seconds of a case; stages that did not run are omitted."""
METHOD_COLUMNS = ("generate", "lift", "register", "integrate", "optimize", OWN)


@dataclass(frozen=True)
class Report:
    """All measurements of one run."""

    machine: Mapping[str, str | int]
    settings: Mapping[str, Any]
    """Seed, repeats, and maximum number of iterations of the baselines."""
    cases: tuple[SampleSet, ...]
    methods: tuple[SampleSet, ...]
    """Measurements on the first target of the first case; ours is the first if present."""
    growth: tuple[Growth, ...]

    @property
    def yardstick(self) -> Spread:
        """Seconds of the yardstick over all measurements."""
        points = [point for series in self.growth for point in series.points]
        everything = [*self.cases, *self.methods, *points]
        return Spread.from_values([s.yardstick for found in everything for s in found.samples])


def build_content(report: Report) -> dict[str, Any]:
    """Return the report as JSON, in seconds, bytes and yardsticks (`ratios`)."""
    return {
        "machine": dict(report.machine),
        "settings": dict(report.settings),
        "yardstick": asdict(report.yardstick),
        "cases": [build_measured_content(case) for case in report.cases],
        "methods": [build_measured_content(method) for method in report.methods],
        "growth": [build_growth_content(series) for series in report.growth],
    }


def build_measured_content(measured: SampleSet) -> dict[str, Any]:
    """Return the samples of a measurement and their statistics."""
    samples = [
        {
            "seconds": dict(sample.seconds),
            "yardstick": sample.yardstick,
            "ratios": sample.ratios,
            "peak_bytes": sample.peak_bytes,
        }
        for sample in measured.samples
    ]
    return {
        "name": measured.name,
        "gaussians": dict(measured.gaussians),
        "peak_bytes": measured.peak_bytes,
        "seconds": {stage: asdict(spread) for stage, spread in measured.seconds.items()},
        "ratios": {stage: asdict(spread) for stage, spread in measured.ratios.items()},
        "samples": samples,
    }


def build_growth_content(series: Growth) -> dict[str, Any]:
    """Return a series with its exponents."""
    return {
        "axis": series.axis,
        "sizes": list(series.sizes),
        "slopes": series.exponents,
        "memory_slope": series.memory_exponent,
        "points": [build_measured_content(point) for point in series.points],
    }


def format_report(report: Report) -> str:
    """Format machine, cases, methods and growth as Markdown."""
    parts = [format_machine(report)]
    if report.cases:
        parts += ["### Cases\n", format_case_table(report.cases)]
        parts += ["The same in yardsticks:\n", format_ratio_table(report.cases)]
    if report.methods:
        parts += ["### Methods\n", format_method_table(report.methods)]
    for series in report.growth:
        parts += [f"### Growth over {series.axis}\n", format_growth_table(series)]
    return "\n".join(parts)


def format_machine(report: Report) -> str:
    """Describe the machine and the measurements."""
    machine = {name.replace("_", " "): value for name, value in report.machine.items()}
    unit = report.yardstick
    return (
        f"{', '.join(f'{name} {value}' for name, value in machine.items())}. "
        f"Medians (smallest to largest) of {report.settings['repeats']}; seconds. "
        f"The yardstick took {format_spread(unit)} s.\n"
    )


def format_case_table(cases: Sequence[SampleSet]) -> str:
    """Format seconds by stage, memory and Gaussians, one row per case."""
    columns = select_columns(cases, COLUMNS)
    head = ["case", *columns, "peak (GB)", "Gaussians", "added"]
    rows = [
        [
            case.name,
            *(format_spread(case.seconds.get(column)) for column in columns),
            format_gigabytes(case.peak_bytes),
            f"{case.gaussians['context']:,}",
            f"{case.gaussians['added']:,}",
        ]
        for case in cases
    ]
    return format_markdown(head, rows)


def format_ratio_table(cases: Sequence[SampleSet]) -> str:
    """Format yardsticks by stage, one row per case."""
    columns = select_columns(cases, COLUMNS)
    rows = [
        [c.name, *(format_spread(c.ratios.get(column), 1) for column in columns)] for c in cases
    ]
    return format_markdown(["case", *columns], rows)


def format_method_table(methods: Sequence[SampleSet]) -> str:
    """Format seconds by stage and the ratio to the first method, one row per method."""
    columns = select_columns(methods, METHOD_COLUMNS)
    head = ["method", *columns, "yardsticks", f"times {methods[0].name}", "peak (GB)"]
    rows = [
        [
            method.name,
            *(format_spread(method.seconds.get(column)) for column in columns),
            format_spread(method.ratios[OWN], 1),
            f"{compute_time_ratio(method, methods[0]):.3g}",
            format_gigabytes(method.peak_bytes),
        ]
        for method in methods
    ]
    return format_markdown(head, rows)


def compute_time_ratio(method: SampleSet, other: SampleSet) -> float:
    """Compute the ratio of the times of two methods, each in yardsticks."""
    return method.ratios[OWN].median / other.ratios[OWN].median


def format_growth_table(series: Growth) -> str:
    """Format seconds by stage, one row per size, with the exponents in the last row."""
    columns = select_columns(series.points, COLUMNS)
    rows = [
        [
            f"{size:,}",
            *(format_spread(point.seconds.get(column)) for column in columns),
            format_gigabytes(point.peak_bytes),
        ]
        for size, point in zip(series.sizes, series.points, strict=True)
    ]
    powers = [*(series.exponents.get(column) for column in columns), series.memory_exponent]
    cells = ["–" if power is None else f"{power:.2f}" for power in powers]
    head = [series.axis, *columns, "peak (GB)"]
    return format_markdown(head, [*rows, ["exponent", *cells]])


def select_columns(found: Sequence[SampleSet], columns: Sequence[str]) -> list[str]:
    """Select the columns with a positive time."""
    return [c for c in columns if any(c in m.stages and m.seconds[c].high > 0 for m in found)]


def format_spread(spread: Spread | None, digits: int = 2) -> str:
    """Format the median, with the range if there are several values."""
    if spread is None:
        return "–"
    median = f"{spread.median:.{digits}f}"
    if spread.low == spread.high:
        return median
    return f"{median} ({spread.low:.{digits}f}–{spread.high:.{digits}f})"


def format_gigabytes(number: int | None) -> str:
    """Format bytes in GB, or a dash if unknown."""
    return "–" if number is None else f"{number / 1e9:.2f}"
