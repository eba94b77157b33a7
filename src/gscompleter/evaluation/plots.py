"""Plot of a run: ΔPSNR by hole size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gscompleter.config import ABLATIONS
from gscompleter.errors import InputError
from gscompleter.evaluation.columns import GAIN
from gscompleter.evaluation.tables import RunSummary
from gscompleter.io.files import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = "osD^vP*X<>"


class PlotsNotAvailable(InputError):  # noqa: N818  (a state of affairs, told in a sentence)
    """Error for a missing matplotlib."""


def draw_plots(summary: RunSummary, out: Path) -> None:
    """Draw `gain_by_hole.png` into `out`, if any case has all methods; equal values, equal bytes.

    Raises `PlotsNotAvailable` without matplotlib.
    """
    if not summary.common_tasks:
        return
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise PlotsNotAvailable(
            f"Plots need matplotlib ({error}); run `pip install gscompleter[evaluation]`."
        ) from error
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    draw_gain_by_hole(figure.add_subplot(), summary)
    figure.legend(loc="outside right upper", fontsize="small")
    with replace_file(out / "gain_by_hole.png") as file:
        figure.savefig(file, format="png", dpi=120, metadata={"Software": None})


def select_plot_methods(methods: Sequence[str]) -> list[str]:
    """Select the methods for the plot: not the context, and no ablations beside other methods."""
    ablations = {*ABLATIONS, "unconstrained", *(f"paper/{name}" for name in ABLATIONS)}
    completing = [name for name in methods if name != "context"]
    others = [name for name in completing if name not in ablations]
    return others or completing or list(methods)


def draw_gain_by_hole(axes: Axes, summary: RunSummary) -> None:
    """Plot the ΔPSNR of each step against the hole fraction."""
    for number, method in enumerate(select_plot_methods(summary.methods)):
        steps = [step for row in summary.rows[method] for step in row["steps"]]
        holes = [100 * step["scores"]["hole_fraction"] for step in steps]
        gains: Any = list(map(GAIN.get_value, steps))
        marker, color = MARKERS[number % len(MARKERS)], f"C{number % 10}"
        axes.plot(holes, gains, marker, color=color, markersize=5, alpha=0.8, label=method)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xlabel("hole at the target (% of its pixels)")
    axes.set_ylabel("ΔPSNR at the target (dB)")
    axes.grid(alpha=0.3)
