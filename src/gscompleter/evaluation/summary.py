"""Means over the tasks of a run, for tables and plots."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError
from gscompleter.evaluation.methods import METHODS
from gscompleter.evaluation.steps import compute_scale_drift
from gscompleter.evaluation.store import list_row_paths, read_json, read_settings
from gscompleter.timing import STAGES

RunRow = dict[str, Any]
"""Output of `evaluate` for a task and a method."""

StepRow = dict[str, Any]
"""A `steps.Step` as JSON."""

Reduction = Callable[[Sequence[float]], Any]
"""Reduces several numbers to one, or to None."""

MIN_PIXELS = 500
"""Smallest number of pixels over which a geometry score counts."""


@dataclass(frozen=True)
class Column:
    """A column of a table: a number of each step, reduced over steps and then over tasks."""

    key: str
    title: str
    digits: int
    path: str
    """Place of the number in a step or its scores, with dots; a list of views is reduced too."""
    minus: str | None = None
    """Place of a number that is subtracted."""
    reduce_steps: Reduction = statistics.fmean
    reduce_tasks: Reduction = statistics.fmean
    pixels: str | None = None
    """Place of the number of pixels, of which `MIN_PIXELS` are needed."""

    def get_value(self, step: StepRow) -> float | int | None:
        """Return the number of a step; None without ground truth or in rows of earlier versions."""
        if self.pixels is not None and (find_number(step, self.pixels) or 0) < MIN_PIXELS:
            return None
        value = find_number(step, self.path)
        if value is None or self.minus is None:
            return self.reduce_steps(value) if isinstance(value, list) else value
        less = find_number(step, self.minus)
        if isinstance(value, list):
            return self.reduce_steps([a - b for a, b in zip(value, less, strict=True)])
        return float(value - less)

    def compute_row(self, row: RunRow) -> float | None:
        """Compute the value of a task, or None if no step has one."""
        values = [value for step in row["steps"] if (value := self.get_value(step)) is not None]
        return self.reduce_steps(values) if values else None


def find_number(step: StepRow, path: str) -> Any:
    """Return the number at a place in a step or its scores, one per view, or None."""
    found: Any = {**step, **step.get("scores", {})}
    for key in path.split("."):
        if isinstance(found, list):
            found = [view[key] for view in found]
        else:
            found = None if found is None else found.get(key)
    return found


BEFORE, AFTER = "target_before.psnr", "target_after.psnr"
PSNR_BEFORE = Column("psnr_before", "PSNR before", 2, BEFORE)
PSNR = Column("psnr", "PSNR", 2, AFTER)
GAIN = Column("gain", "ΔPSNR", 2, AFTER, BEFORE)


def _make_gain(key: str, title: str, path: str, reduce: Reduction = statistics.fmean) -> Column:
    """Make a column of changes by the completion."""
    return Column(key, title, 2, f"{path}.after", f"{path}.before", reduce, reduce)


def _make_median(key: str, title: str, path: str, digits: int = 0) -> Column:
    """Make a column of medians over the tasks."""
    return Column(key, title, digits, path, reduce_tasks=statistics.median)


IMAGES = (
    PSNR,
    GAIN,
    Column("lowest_gain", "min ΔPSNR", 2, AFTER, BEFORE, min, min),
    Column("ssim", "SSIM", 3, "target_after.ssim"),
    Column("lpips_vgg", "LPIPS (VGG)", 3, "target_after.lpips_vgg"),
    Column("lpips_alex", "LPIPS (Alex)", 3, "target_after.lpips_alex"),
    Column("hole_psnr", "PSNR (hole)", 2, "hole_psnr"),
    Column("observed_psnr", "PSNR (observed)", 2, "observed_psnr.after"),
    Column("neighbours", "PSNR (neighbour views)", 2, "neighbours_psnr.after"),
    _make_gain("neighbours_gain", "ΔPSNR (neighbour views)", "neighbours_psnr"),
    Column("context", "PSNR (context)", 2, "context_psnr.after"),
    Column("context_ssim", "SSIM (context)", 3, "context_ssim.after"),
    _make_gain("context_change", "min ΔPSNR (context)", "context_psnr", min),
)
"""PSNR in dB at the target, in its hole and observed part, at neighbour and context views."""

PERCEPTUAL = (
    Column("hole_flip", "FLIP (hole)", 3, "hole_looks.flip"),
    Column("observed_flip", "FLIP (observed)", 3, "observed_looks.flip"),
    Column("hole_haarpsi", "HaarPSI (hole)", 3, "hole_looks.haarpsi"),
    Column("observed_haarpsi", "HaarPSI (observed)", 3, "observed_looks.haarpsi"),
    _make_median("hole_gradients", "gradient energy (hole)", "hole_looks.gradient_energy", 2),
    _make_median(
        "observed_gradients", "gradient energy (observed)", "observed_looks.gradient_energy", 2
    ),
)
"""Scores at the target that do not reward blur.

The best FLIP is 0 and the best HaarPSI 1; a gradient energy of 1 is as sharp as the photograph. The
energy is a median over the tasks, since a flat photograph gives arbitrary ratios.
"""


def _make_mean_and_median(key: str, title: str, digits: int, pixels: str) -> tuple[Column, Column]:
    """Make columns of the mean and median over the tasks with enough pixels."""
    mean = Column(key, title, digits, key, pixels=pixels)
    median = replace(
        mean, key=f"{key}_median", title=f"{title} (median)", reduce_tasks=statistics.median
    )
    return mean, median


GEOMETRY = (
    *_make_mean_and_median("depth_observed", "AbsRel observed", 3, "depth_observed_pixels"),
    _make_median("depth_observed_pixels", "pixels observed", "depth_observed_pixels"),
    *_make_mean_and_median("depth_hole", "AbsRel in holes", 3, "depth_hole_pixels"),
    _make_median("depth_hole_pixels", "pixels in holes", "depth_hole_pixels"),
)

ADDED = (
    *_make_mean_and_median("depth_rim", "depth step at seam", 4, "align_pixels"),
    *_make_mean_and_median("align_abs_rel", "AbsRel to context", 4, "align_pixels"),
    *_make_mean_and_median("align_chamfer", "Chamfer to context", 4, "align_pixels"),
    *_make_mean_and_median("align_f_score", "F-score to context", 3, "align_pixels"),
    _make_median("align_pixels", "pixels of overlap", "align_pixels"),
)
"""Added Gaussians against the context; lengths are relative to the depth."""

LIFTED = (
    *_make_mean_and_median("registered_abs_rel", "AbsRel of all lifted", 4, "registered_pixels"),
    *_make_mean_and_median("registered_chamfer", "Chamfer of all lifted", 4, "registered_pixels"),
    *_make_mean_and_median("registered_f_score", "F-score of all lifted", 3, "registered_pixels"),
    _make_median("registered_pixels", "pixels of all lifted", "registered_pixels"),
)
"""The same for all lifted Gaussians after registration, before the hole filter."""

SEQUENCE = (
    PSNR_BEFORE,
    Column("psnr_end", "PSNR at the end", 2, "psnr_end"),
    Column("depth_scale", "depth scale", 3, "depth_scale"),
    Column("scale_drift", "scale drift", 3, "depth_scale", reduce_steps=compute_scale_drift),
)

GROUPS = {
    "Images": IMAGES,
    "Perceptual quality": PERCEPTUAL,
    "Geometry": GEOMETRY,
    "Geometry of added Gaussians": ADDED,
    "Geometry of all lifted Gaussians": LIFTED,
    "Sequences": SEQUENCE,
}

METHOD_NOTES = {
    "reggs": (
        "reggs gets our metric lift and the true poses. RegGS in its paper gets neither, so this "
        "row is not comparable with that paper."
    ),
}

FEW_PIXELS_NOTE = (
    f"A geometry score counts if it is measured over at least {MIN_PIXELS} pixels; the columns of "
    "pixels are medians over all cases."
)


@dataclass(frozen=True)
class TableCell:
    """A reduced value over the tasks that have one."""

    value: float | None
    count: int


@dataclass(frozen=True)
class RunSummary:
    """All data of the tables."""

    methods: tuple[str, ...]
    tasks: tuple[str, ...]
    common_tasks: tuple[str, ...]
    """Tasks that all methods finished."""
    rows: Mapping[str, tuple[RunRow, ...]]
    """Rows of the common tasks in their order, by method."""
    sequences: Mapping[str, Mapping[str, Sequence[StepRow]]]
    """Finished steps by task of several steps and by method."""
    gains: Mapping[int, Mapping[str, TableCell]]
    """Mean ΔPSNR of a step in dB, by frames to the nearest context frame and by method."""
    finished: Mapping[str, int]
    """Number of finished tasks by method."""
    failures: tuple[tuple[str, str, str], ...]
    """Task, method, reason."""

    @property
    def groups(self) -> dict[str, tuple[Column, ...]]:
        """Columns that may have a value, by the title of their table."""
        return {t: columns for t, columns in GROUPS.items() if t != "Sequences" or self.sequences}

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of all groups."""
        return tuple(column for group in self.groups.values() for column in group)

    @property
    def notes(self) -> list[str]:
        """Notes on the tables."""
        has_geometry = self.find_present_columns((*GEOMETRY, *ADDED, *LIFTED))
        of_methods = [METHOD_NOTES[method] for method in self.methods if method in METHOD_NOTES]
        return [FEW_PIXELS_NOTE, *of_methods] if has_geometry else of_methods

    @property
    def num_steps(self) -> int:
        """Number of steps in the common tasks."""
        return sum(len(row["steps"]) for row in next(iter(self.rows.values())))

    def compute_cell(self, method: str, column: Column) -> TableCell:
        """Compute the entry of a table."""
        return make_cell((column.compute_row(row) for row in self.rows[method]), column)

    def find_present_columns(self, columns: Iterable[Column]) -> list[Column]:
        """Return the columns in which any method has a value."""
        return [c for c in columns if any(self.compute_cell(m, c).count for m in self.methods)]

    def compute_seconds(self, method: str) -> dict[str, float]:
        """Compute the median wall time over the steps by stage.

        `reconstruct` is Ψ on the photographs, once per task; `total` does not include it.
        """
        rows = self.rows[method]
        if not rows:
            return {}
        steps = [step["seconds"] for row in rows for step in row["steps"]]
        stages = sorted({stage for step in steps for stage in step}, key=rank_stage)
        medians = {s: statistics.median(step.get(s, 0.0) for step in steps) for s in stages}
        return {"reconstruct": statistics.median(r["reconstruct_seconds"] for r in rows), **medians}

    def find_peak_bytes(self, method: str) -> int | None:
        """Return the peak memory of all steps, or None if it is unknown."""
        peaks = (step["peak_bytes"] for row in self.rows[method] for step in row["steps"])
        return max((peak for peak in peaks if peak is not None), default=None)


def make_cell(numbers: Iterable[float | None], column: Column) -> TableCell:
    """Reduce the known numbers as `column` says."""
    values = [value for value in numbers if value is not None]
    return TableCell(column.reduce_tasks(values) if values else None, len(values))


def read_rows(out: Path) -> list[RunRow]:
    """Read the rows of a run in the order of tasks and methods."""
    read_settings(out)
    rows = [read_row(path) for path in list_row_paths(out)]
    if not rows:
        raise InputError(
            f"The run in {out} has no finished case; run `gscompleter evaluate` first."
        )
    return sorted(rows, key=lambda row: (row["task"]["name"], *rank_method(row["method"])))


def read_row(path: Path) -> RunRow:
    """Read the row of a task and a method."""
    row = read_json(path)
    try:
        row["task"]["name"], row["error"], row["reconstruct_seconds"]
        whole = isinstance(row["method"], str) and isinstance(row["steps"], list)
    except (KeyError, TypeError):
        whole = False
    if not whole:
        raise InputError(f"{path} is no row of scores; delete it and run again.")
    return dict(row)


def rank_method(method: str) -> tuple[int, str]:
    """Return the sort key of a method in tables."""
    return _rank_name(method, list(METHODS))


def rank_stage(stage: str) -> tuple[int, str]:
    """Return the sort key of a stage in running order."""
    return _rank_name(stage, ["reconstruct", *STAGES, "optimize"])


def _rank_name(name: str, order: Sequence[str]) -> tuple[int, str]:
    return (order.index(name) if name in order else len(order), name)


def summarize_run(rows: Sequence[RunRow]) -> RunSummary:
    """Average over the tasks that all methods finished, for a fair comparison."""
    methods = tuple(sorted({row["method"] for row in rows}, key=rank_method))
    by_task: dict[str, dict[str, RunRow]] = {}
    for row in sorted(rows, key=lambda row: row["task"]["name"]):
        by_task.setdefault(row["task"]["name"], {})[row["method"]] = row
    done = {
        name: {m: row for m, row in found.items() if row["error"] is None}
        for name, found in by_task.items()
    }
    common = tuple(name for name, found in done.items() if len(found) == len(methods))
    chosen = {method: tuple(done[name][method] for name in common) for method in methods}
    return RunSummary(
        methods,
        tuple(by_task),
        common,
        chosen,
        {
            name: {method: row["steps"] for method, row in found.items()}
            for name, found in by_task.items()
            if any(len(row["task"]["targets"]) > 1 for row in found.values())
        },
        average_gains_by_gap(chosen),
        {method: sum(method in found for found in done.values()) for method in methods},
        tuple((r["task"]["name"], r["method"], r["error"]) for r in rows if r["error"] is not None),
    )


def list_steps_with_gaps(row: RunRow) -> Iterator[tuple[int, StepRow]]:
    """Yield each step with the frames from its target to the nearest known frame: k of n-k."""
    known = list(row["task"]["context"])
    for step in row["steps"]:
        yield min(abs(step["frame"] - frame) for frame in known), step
        known.append(step["frame"])


def average_gains_by_gap(rows: Mapping[str, Sequence[RunRow]]) -> dict[int, dict[str, TableCell]]:
    """Average the ΔPSNR of each method by distance to the known views."""
    gains: dict[int, dict[str, list[float | None]]] = {}
    for method, chosen in rows.items():
        for gap, step in (pair for row in chosen for pair in list_steps_with_gaps(row)):
            of_gap = gains.setdefault(gap, {method: [] for method in rows})
            of_gap[method].append(GAIN.get_value(step))
    return {
        gap: {method: make_cell(values, GAIN) for method, values in gains[gap].items()}
        for gap in sorted(gains)
    }
