"""Means over the tasks of a run, for tables and plots."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError
from gscompleter.evaluation.methods import METHODS
from gscompleter.evaluation.steps import compute_scale_drift
from gscompleter.evaluation.store import check_run, list_row_paths, read_json
from gscompleter.timing import STAGES

RunRow = dict[str, Any]
"""Output of `evaluate` for a task and a method."""

StepRow = dict[str, Any]
"""A `steps.StepRow` as JSON."""


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    key: str
    title: str
    digits: int
    get_value: Callable[[StepRow], float | None]
    """Value of a step; None without ground truth."""
    reduce_steps: Callable[[Sequence[float]], float | None] = statistics.fmean
    reduce_tasks: Callable[[Sequence[float]], float] = statistics.fmean

    def compute_row(self, row: RunRow) -> float | None:
        """Compute the value of a task, or None if no step has one."""
        values = [value for step in row["steps"] if (value := self.get_value(step)) is not None]
        return self.reduce_steps(values) if values else None


def get_psnr_before(step: StepRow) -> float:
    """Return the PSNR at the target before a step, in dB."""
    return float(step["scores"]["target_before"]["psnr"])


def get_psnr_after(step: StepRow) -> float:
    """Return the PSNR at the target after a step, in dB."""
    return float(step["scores"]["target_after"]["psnr"])


def compute_psnr_gain(step: StepRow) -> float:
    """Compute the ΔPSNR at the target of a step, in dB."""
    return get_psnr_after(step) - get_psnr_before(step)


def _make_score_getter(*path: str) -> Callable[[StepRow], float | None]:
    """Make a getter of a score by its path; None if missing, as in rows of earlier versions."""
    return lambda step: reduce(
        lambda found, key: None if found is None else found.get(key), path, step["scores"]
    )


def _make_change_getter(key: str) -> Callable[[StepRow], float | None]:
    def change(step: StepRow) -> float | None:
        both = step["scores"][key]
        return None if both is None else both["after"] - both["before"]

    return change


def _find_worst_change(step: StepRow) -> float:
    return min(view["after"] - view["before"] for view in step["scores"]["context_psnr"])


def _make_view_mean(key: str) -> Callable[[StepRow], float]:
    return lambda step: statistics.fmean(view["after"] for view in step["scores"][key])


def _make_step_getter(key: str) -> Callable[[StepRow], float | None]:
    return lambda step: step[key]


GAIN = Column("gain", "ΔPSNR", 2, compute_psnr_gain)

IMAGES = (
    Column("psnr", "PSNR", 2, get_psnr_after),
    GAIN,
    Column("lowest_gain", "min ΔPSNR", 2, compute_psnr_gain, min, min),
    Column("ssim", "SSIM", 3, _make_score_getter("target_after", "ssim")),
    Column("lpips_vgg", "LPIPS (VGG)", 3, _make_score_getter("target_after", "lpips_vgg")),
    Column("lpips_alex", "LPIPS (Alex)", 3, _make_score_getter("target_after", "lpips_alex")),
    Column("hole_psnr", "PSNR (hole)", 2, _make_score_getter("hole_psnr")),
    Column("observed_psnr", "PSNR (observed)", 2, _make_score_getter("observed_psnr", "after")),
    Column(
        "neighbours", "PSNR (neighbour views)", 2, _make_score_getter("neighbours_psnr", "after")
    ),
    Column("neighbours_gain", "ΔPSNR (neighbour views)", 2, _make_change_getter("neighbours_psnr")),
    Column("context", "PSNR (context)", 2, _make_view_mean("context_psnr")),
    Column("context_ssim", "SSIM (context)", 3, _make_view_mean("context_ssim")),
    Column("context_change", "min ΔPSNR (context)", 2, _find_worst_change, min, min),
)
"""PSNR in dB at the target, in its hole and observed part, at neighbour and context views."""

PERCEPTUAL = (
    Column("hole_flip", "FLIP (hole)", 3, _make_score_getter("hole_looks", "flip")),
    Column("observed_flip", "FLIP (observed)", 3, _make_score_getter("observed_looks", "flip")),
    Column("hole_haarpsi", "HaarPSI (hole)", 3, _make_score_getter("hole_looks", "haarpsi")),
    Column(
        "observed_haarpsi", "HaarPSI (observed)", 3, _make_score_getter("observed_looks", "haarpsi")
    ),
    Column(
        "hole_gradients",
        "gradient energy (hole)",
        2,
        _make_score_getter("hole_looks", "gradient_energy"),
        reduce_tasks=statistics.median,
    ),
    Column(
        "observed_gradients",
        "gradient energy (observed)",
        2,
        _make_score_getter("observed_looks", "gradient_energy"),
        reduce_tasks=statistics.median,
    ),
)
"""Scores at the target that do not reward blur.

The best FLIP is 0 and the best HaarPSI 1; a gradient energy of 1 is as sharp as the photograph. The
energy is a median over the tasks, since a flat photograph gives arbitrary ratios.
"""

MIN_PIXELS = 500
"""Smallest number of pixels over which a geometry score counts."""


def _make_measured_getter(key: str, pixels: str) -> Callable[[StepRow], float | None]:
    """Make a getter of the score `key`; None if it has too few `pixels`."""
    number, count = _make_score_getter(key), _make_score_getter(pixels)
    return lambda step: number(step) if (count(step) or 0) >= MIN_PIXELS else None


def _make_mean_and_median(key: str, title: str, digits: int, pixels: str) -> tuple[Column, Column]:
    """Make columns of the mean and median over the tasks with enough pixels."""
    mean = Column(key, title, digits, _make_measured_getter(key, pixels))
    median = replace(
        mean, key=f"{key}_median", title=f"{title} (median)", reduce_tasks=statistics.median
    )
    return mean, median


def _make_pixel_column(key: str, title: str) -> Column:
    """Make a column of the median number of pixels over all tasks."""
    return Column(key, title, 0, _make_score_getter(key), reduce_tasks=statistics.median)


GEOMETRY = (
    *_make_mean_and_median("depth_observed", "AbsRel observed", 3, "depth_observed_pixels"),
    _make_pixel_column("depth_observed_pixels", "pixels observed"),
    *_make_mean_and_median("depth_hole", "AbsRel in holes", 3, "depth_hole_pixels"),
    _make_pixel_column("depth_hole_pixels", "pixels in holes"),
)

ADDED = (
    *_make_mean_and_median("depth_rim", "depth step at seam", 4, "align_pixels"),
    *_make_mean_and_median("align_abs_rel", "AbsRel to context", 4, "align_pixels"),
    *_make_mean_and_median("align_chamfer", "Chamfer to context", 4, "align_pixels"),
    *_make_mean_and_median("align_f_score", "F-score to context", 3, "align_pixels"),
    _make_pixel_column("align_pixels", "pixels of overlap"),
)
"""Added Gaussians against the context; lengths are relative to the depth."""

LIFTED = (
    *_make_mean_and_median("registered_abs_rel", "AbsRel of all lifted", 4, "registered_pixels"),
    *_make_mean_and_median("registered_chamfer", "Chamfer of all lifted", 4, "registered_pixels"),
    *_make_mean_and_median("registered_f_score", "F-score of all lifted", 3, "registered_pixels"),
    _make_pixel_column("registered_pixels", "pixels of all lifted"),
)
"""The same for all lifted Gaussians after registration, before the hole filter."""

SEQUENCE = (
    Column("psnr_before", "PSNR before", 2, get_psnr_before),
    Column("psnr_end", "PSNR at the end", 2, _make_step_getter("psnr_end")),
    Column("depth_scale", "depth scale", 3, _make_step_getter("depth_scale")),
    Column("scale_drift", "scale drift", 3, _make_step_getter("depth_scale"), compute_scale_drift),
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

NO_PIXELS_NOTE = (
    "Some rows are from an earlier version, which counted no pixels, so their geometry is left "
    "out; score the run again to add it."
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
        return {
            title: columns
            for title, columns in GROUPS.items()
            if columns is not SEQUENCE or self.sequences
        }

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of all groups."""
        return tuple(column for group in self.groups.values() for column in group)

    @property
    def notes(self) -> list[str]:
        """Notes on the tables."""
        scores = [s["scores"] for rows in self.rows.values() for row in rows for s in row["steps"]]
        geometry = {
            FEW_PIXELS_NOTE: bool(self.find_present_columns((*GEOMETRY, *ADDED, *LIFTED))),
            NO_PIXELS_NOTE: any("align_pixels" not in found for found in scores),
        }
        of_methods = [METHOD_NOTES[method] for method in self.methods if method in METHOD_NOTES]
        return [*(note for note, holds in geometry.items() if holds), *of_methods]

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


def read_rows(out: Path) -> list[RunRow]:
    """Read the rows of a run in the order of tasks and methods."""
    check_run(out)
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
    tasks = tuple(sorted({row["task"]["name"] for row in rows}))
    by_task: dict[str, dict[str, RunRow]] = {name: {} for name in tasks}
    for row in rows:
        by_task[row["task"]["name"]][row["method"]] = row
    done = {
        name: {m: row for m, row in found.items() if row["error"] is None}
        for name, found in by_task.items()
    }
    common = tuple(name for name in tasks if len(done[name]) == len(methods))
    chosen = {method: tuple(done[name][method] for name in common) for method in methods}
    return RunSummary(
        methods,
        tasks,
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


def make_cell(numbers: Iterable[float | None], column: Column) -> TableCell:
    """Reduce the known numbers as `column` says."""
    values = [value for value in numbers if value is not None]
    return TableCell(column.reduce_tasks(values) if values else None, len(values))


def list_steps_with_gaps(row: RunRow) -> Iterator[tuple[int, StepRow]]:
    """Yield each step with the frames from its target to the nearest known frame: k of n-k."""
    known = list(row["task"]["context"])
    for step in row["steps"]:
        yield min(abs(step["frame"] - frame) for frame in known), step
        known.append(step["frame"])


def average_gains_by_gap(rows: Mapping[str, Sequence[RunRow]]) -> dict[int, dict[str, TableCell]]:
    """Average the ΔPSNR of each method by distance to the known views."""
    found = {
        method: [pair for row in chosen for pair in list_steps_with_gaps(row)]
        for method, chosen in rows.items()
    }
    gaps = sorted({gap for pairs in found.values() for gap, _ in pairs})
    return {
        gap: {
            method: make_cell(
                (compute_psnr_gain(step) for there, step in pairs if there == gap), GAIN
            )
            for method, pairs in found.items()
        }
        for gap in gaps
    }
