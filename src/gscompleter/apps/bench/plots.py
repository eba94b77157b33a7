"""Growth as curves with logarithmic axes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gscompleter.apps.bench.completions import PROCESS, REST
from gscompleter.apps.bench.growth import Growth
from gscompleter.evaluation.plots import create_plot_figure, get_curve_style, write_figure
from gscompleter.timing import STAGES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CURVES = (*STAGES, REST, PROCESS)


def plot_growth(path: Path, growth: Sequence[Growth]) -> Path:
    """Write a PNG with one panel per series; raise PlotsNotAvailable without matplotlib."""
    figure = create_plot_figure(3.2 * len(growth))
    panels = figure.subplots(len(growth), squeeze=False)[:, 0]
    for axes, series in zip(panels, growth, strict=True):
        plot_series(axes, series)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper")
    return write_figure(figure, path)


def plot_series(axes: Axes, series: Growth) -> None:
    """Plot the median seconds of each stage against size."""
    for number, stage in enumerate(CURVES):
        if stage in series.points[0].stages:
            axes.plot(
                series.sizes,
                series.get_medians(stage),
                label=stage,
                linewidth=1,
                **get_curve_style(number),
            )
    axes.set_xscale("log")
    axes.set_yscale("log")
    found = series.exponents[PROCESS]
    axes.set_xlabel(series.axis if found is None else f"{series.axis} (process: {found:.2f})")
    axes.set_ylabel("seconds")
    axes.grid(alpha=0.3)
