"""The command `bench`: measure completions and how their time grows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from gscompleter.apps.commands.shared_options import RunOptions, WritingOptions
from gscompleter.system.process import import_without_collection

Axis = Literal["gaussians", "pixels", "views", "targets"]


@dataclass(frozen=True, kw_only=True)
class BenchOptions(RunOptions, WritingOptions):
    """Measure how long completions take on this machine and how the time grows.

    Every completion is a process of its own, start-up included. Times are also given relative to
    one pass of the renderer, forward and backward, with 196,608 Gaussians at 256 x 256. Without
    cases the pair of `demo` is measured.

    Example: gscompleter bench --quick
    """

    cases: Path | None = None
    """JSON file of scenes with their frames and growth series, as benchmarks/performance.json."""
    in_process: bool = False
    """Run all completions in this process, as a program does that uses the library."""
    generators: tuple[str, ...] = ()
    """Compare these generators instead, at the first target of each case: seconds, and scores in
    holes."""
    growth: tuple[Axis, ...] = ("gaussians", "pixels", "views", "targets")
    """Quantities to increase in the first case."""
    repeats: Annotated[int, Interval(ge=1, le=1000)] = 5
    """Number of repetitions."""
    quick: bool = False
    """Run a quick check: the smallest case once, no growth."""
    out: Path | None = None
    """Write results here. A folder, for bench.json and tables.md."""


def run_bench(options: BenchOptions) -> None:
    """Measure the cases, and print or write the tables."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.bench.running import measure_completions
    measure_completions(options)
