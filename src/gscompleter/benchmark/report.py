"""What was measured, as tables in Markdown and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from gscompleter.benchmark.comparison import OWN
from gscompleter.benchmark.completions import PROCESS, REST
from gscompleter.benchmark.growth import Growth
from gscompleter.benchmark.samples import Measured, Spread
from gscompleter.completer import STAGES
from gscompleter.reports.tables import markdown

COLUMNS = (*STAGES, "total", REST, PROCESS)
"""Of the seconds of a case. A stage that it did not have is left out."""
METHOD_COLUMNS = ("generate", "lift", "register", "integrate", "optimize", OWN)


@dataclass(frozen=True)
class Report:
    """All that was measured in one run."""

    machine: Mapping[str, str | int]
    settings: Mapping[str, Any]
    """What was asked for: seed, repeats, and most iterations of the baselines."""
    cases: tuple[Measured, ...]
    methods: tuple[Measured, ...]
    """On the first target of the first case; ours first, where it is among them."""
    growth: tuple[Growth, ...]

    @property
    def yardstick(self) -> Spread:
        """Seconds of the yardstick beside all of it."""
        points = [point for series in self.growth for point in series.points]
        everything = [*self.cases, *self.methods, *points]
        return Spread.of([s.yardstick for found in everything for s in found.samples])


def content(report: Report) -> dict[str, Any]:
    """The report as JSON has it. Seconds; bytes; ratios are seconds in yardsticks."""
    return {
        "machine": dict(report.machine),
        "settings": dict(report.settings),
        "yardstick": asdict(report.yardstick),
        "cases": [measured_content(case) for case in report.cases],
        "methods": [measured_content(method) for method in report.methods],
        "growth": [growth_content(series) for series in report.growth],
    }


def measured_content(measured: Measured) -> dict[str, Any]:
    """Every sample, and what they come to."""
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


def growth_content(series: Growth) -> dict[str, Any]:
    """A series with its slopes."""
    return {
        "axis": series.axis,
        "sizes": list(series.sizes),
        "slopes": series.slopes,
        "memory_slope": series.memory_slope,
        "points": [measured_content(point) for point in series.points],
    }


def report_markdown(report: Report) -> str:
    """Machine, cases, methods and growth."""
    parts = [machine_line(report)]
    if report.cases:
        parts += ["### Cases\n", case_table(report.cases)]
        parts += ["The same in yardsticks:\n", ratio_table(report.cases)]
    if report.methods:
        parts += ["### Methods\n", method_table(report.methods)]
    for series in report.growth:
        parts += [f"### Growth over {series.axis}\n", growth_table(series)]
    return "\n".join(parts)


def machine_line(report: Report) -> str:
    """Where and how it was measured."""
    machine = {name.replace("_", " "): value for name, value in report.machine.items()}
    unit = report.yardstick
    return (
        f"{', '.join(f'{name} {value}' for name, value in machine.items())}. "
        f"Medians (smallest to largest) of {report.settings['repeats']}; seconds. "
        f"The yardstick took {cell(unit)} s.\n"
    )


def case_table(cases: Sequence[Measured]) -> str:
    """Seconds by stage, memory and Gaussians, a row per case."""
    columns = present(cases, COLUMNS)
    head = ["case", *columns, "peak (GB)", "Gaussians", "added"]
    rows = [
        [
            case.name,
            *(cell(case.seconds.get(column)) for column in columns),
            gigabytes(case.peak_bytes),
            f"{case.gaussians['context']:,}",
            f"{case.gaussians['added']:,}",
        ]
        for case in cases
    ]
    return markdown(head, rows)


def ratio_table(cases: Sequence[Measured]) -> str:
    """Yardsticks by stage, a row per case."""
    columns = present(cases, COLUMNS)
    rows = [[c.name, *(cell(c.ratios.get(column), 1) for column in columns)] for c in cases]
    return markdown(["case", *columns], rows)


def method_table(methods: Sequence[Measured]) -> str:
    """Seconds by stage, and how many times as long as ours, a row per method."""
    columns = present(methods, METHOD_COLUMNS)
    head = ["method", *columns, "yardsticks", f"times {methods[0].name}", "peak (GB)"]
    rows = [
        [
            method.name,
            *(cell(method.seconds.get(column)) for column in columns),
            cell(method.ratios[OWN], 1),
            f"{times(method, methods[0]):.3g}",
            gigabytes(method.peak_bytes),
        ]
        for method in methods
    ]
    return markdown(head, rows)


def times(method: Measured, other: Measured) -> float:
    """How many times as long a method takes as another, in yardsticks beside each."""
    return method.ratios[OWN].median / other.ratios[OWN].median


def growth_table(series: Growth) -> str:
    """Seconds by stage, a row per size, and the exponents below."""
    columns = present(series.points, COLUMNS)
    rows = [
        [
            f"{size:,}",
            *(cell(point.seconds.get(column)) for column in columns),
            gigabytes(point.peak_bytes),
        ]
        for size, point in zip(series.sizes, series.points, strict=True)
    ]
    slopes = [*(series.slopes.get(column) for column in columns), series.memory_slope]
    exponents = ["–" if found is None else f"{found:.2f}" for found in slopes]
    head = [series.axis, *columns, "peak (GB)"]
    return markdown(head, [*rows, ["exponent", *exponents]])


def present(found: Sequence[Measured], columns: Sequence[str]) -> list[str]:
    """Those of `columns` that took any time."""
    return [c for c in columns if any(c in m.stages and m.seconds[c].high > 0 for m in found)]


def cell(spread: Spread | None, digits: int = 2) -> str:
    """The median, and between which values it lies where there are several."""
    if spread is None:
        return "–"
    median = f"{spread.median:.{digits}f}"
    if spread.low == spread.high:
        return median
    return f"{median} ({spread.low:.{digits}f}–{spread.high:.{digits}f})"


def gigabytes(number: int | None) -> str:
    """A dash where the system did not tell."""
    return "–" if number is None else f"{number / 1e9:.2f}"
