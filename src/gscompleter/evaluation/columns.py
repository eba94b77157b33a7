"""Columns of the tables: which numbers of a row they show, and how these are averaged."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gscompleter.evaluation.steps import compute_scale_drift
from gscompleter.system.timing import STAGES

RunRow = dict[str, Any]
"""Result of a method on a task as JSON, with its `steps`."""
StepRow = dict[str, Any]
"""A `SequenceStep` as JSON, whose `scores` are `Scores`."""

Reduction = Callable[[Sequence[float]], Any]
"""Reduces several numbers to one, or to None."""

MIN_GEOMETRY_PIXELS = 500
"""Smallest number of pixels over which a geometry score counts."""


@dataclass(frozen=True)
class Column:
    """A column of a table: a number of each step, reduced over steps and then over tasks."""

    key: str
    """Name in files and claims."""
    title: str
    """Heading in tables."""
    digits: int
    """Decimals that are shown."""
    path: str
    """Place of the number in a step or its scores (`find_number`)."""
    minus: str | None = None
    """Place of a number that is subtracted, in the same way; None for none."""
    reduce_steps: Reduction = statistics.fmean
    """Reduces the numbers of the views of a step, and those of the steps of a task."""
    reduce_tasks: Reduction = statistics.fmean
    """Reduces the numbers of all tasks."""
    pixels: str | None = None
    """Place of the number of pixels that the score is of, at least `MIN_GEOMETRY_PIXELS`; None for
    a score that counts however many they are."""

    def get_value(self, step: StepRow) -> float | None:
        """Return the number of a step; None if nothing was measured, or at too few pixels."""
        # A score of few pixels says more about them than about the method.
        if self.pixels is not None and (find_number(step, self.pixels) or 0) < MIN_GEOMETRY_PIXELS:
            return None
        value = find_number(step, self.path)
        # A list has a number for each view; the subtracted ones are then as many.
        if value is not None and self.minus is not None:
            value = np.subtract(value, find_number(step, self.minus)).tolist()
        if isinstance(value, list):
            return self.reduce_steps(value) if value else None
        return None if value is None else float(value)

    def compute_row(self, row: RunRow) -> float | None:
        """Compute the value of a task, or None if no step has one."""
        values = [self.get_value(step) for step in row["steps"]]
        known = [value for value in values if value is not None]
        return self.reduce_steps(known) if known else None


def find_number(step: StepRow, path: str) -> Any:
    """Return the number at a place in a step or its scores; None if nothing was measured there.

    Keys of a place are joined by dots. Where a list of views lies on the way, numbers are one for
    each view.
    """
    # By the whole place: `added` is a number of a step, and `added.pixels` one of its scores.
    is_direct = path in step or path.startswith("seconds.")
    value: Any = step if is_direct else step["scores"]
    for key in path.split("."):
        if isinstance(value, list):
            value = [view[key] for view in value]
        else:
            value = None if value is None else value.get(key)
    return value


def _make_median(key: str, title: str, digits: int, path: str) -> Column:
    """Make a column of medians over the tasks; steps are averaged."""
    return Column(key, title, digits, path, reduce_tasks=statistics.median)


def _make_geometry(
    key: str, title: str, path: str, digits: int = 3, reduce: Reduction = statistics.median
) -> Column:
    """Make a column of a number of a `SurfaceAgreement`, which has its pixels beside it."""
    pixels = f"{path.split('.')[0]}.pixels"
    return Column(key, title, digits, path, reduce_tasks=reduce, pixels=pixels)


def _make_agreements(path: str, title: str, key: str = "registered") -> tuple[Column, ...]:
    """Make the columns of a `SurfaceAgreement` with the context: medians over the tasks."""
    numbers = (("abs_rel", "AbsRel", 4), ("chamfer", "Chamfer", 4), ("f_score", "F-score", 3))
    return tuple(
        _make_geometry(f"{key}_{name}_median", f"{of} {title} (median)", f"{path}.{name}", digits)
        for name, of, digits in numbers
    )


# Places of PSNR at the target, beside it, and at the photographs of the context.
BEFORE = "target_before.psnr"
AFTER = "target_after.psnr"
NEAR_GAPS = "neighbours_thin_gaps.after"
NEAR_BEFORE = "neighbours_psnr.before"
NEAR_AFTER = "neighbours_psnr.after"
SEEN_BEFORE = "context_psnr.before"
SEEN_AFTER = "context_psnr.after"
PSNR_BEFORE = Column("psnr_before", "PSNR before", 2, BEFORE)
PSNR = Column("psnr", "PSNR", 2, AFTER)
GAIN = Column("gain", "ΔPSNR", 2, AFTER, BEFORE)

COLUMN_GROUPS = {
    "Images": (
        PSNR,
        GAIN,
        Column("lowest_gain", "min ΔPSNR", 2, AFTER, BEFORE, min, min),
        Column("ssim", "SSIM", 3, "target_after.ssim"),
        Column("lpips_vgg", "LPIPS (VGG)", 3, "target_after.lpips_vgg"),
        Column("lpips_alex", "LPIPS (Alex)", 3, "target_after.lpips_alex"),
        Column("st_lpips", "ST-LPIPS", 4, "target_after.st_lpips"),
        Column("hole_psnr", "PSNR (hole)", 2, "hole.psnr"),
        Column("observed_psnr", "PSNR (observed)", 2, "observed.psnr"),
        Column("fitted", "PSNR (camera fitted)", 2, "fitted.psnr"),
        Column("fitted_observed", "PSNR (observed, camera fitted)", 2, "fitted.observed_psnr"),
        Column("neighbours", "PSNR (neighbour views)", 2, NEAR_AFTER),
        Column("neighbours_gain", "ΔPSNR (neighbour views)", 2, NEAR_AFTER, NEAR_BEFORE),
        Column("context", "PSNR (context)", 2, SEEN_AFTER),
        Column("context_ssim", "SSIM (context)", 3, "context_ssim.after"),
        Column("context_change", "min ΔPSNR (context)", 2, SEEN_AFTER, SEEN_BEFORE, min, min),
    ),
    # 0 is the best FLIP, 1 the best HaarPSI, and 1 the gradient energy of the photograph. That is a
    # median, since a flat photograph gives arbitrary ratios.
    "Perceptual quality": (
        Column("hole_flip", "FLIP (hole)", 3, "hole.flip"),
        Column("observed_flip", "FLIP (observed)", 3, "observed.flip"),
        Column("hole_haarpsi", "HaarPSI (hole)", 3, "hole.haarpsi"),
        Column("observed_haarpsi", "HaarPSI (observed)", 3, "observed.haarpsi"),
        _make_median("hole_gradients", "gradient energy (hole)", 2, "hole.gradient_energy"),
        _make_median(
            "observed_gradients", "gradient energy (observed)", 2, "observed.gradient_energy"
        ),
    ),
    # Shares of the image; 0 is the best.
    "Thin gaps": (
        Column("thin_gaps", "thin gaps", 5, "thin_gaps.after"),
        Column("neighbours_thin_gaps", "thin gaps (neighbour views)", 5, NEAR_GAPS),
        Column("flight_thin_gaps", "thin gaps (flight to the target)", 5, "flight_thin_gaps.after"),
    ),
    "Geometry": (
        _make_geometry(
            "depth_observed", "AbsRel observed", "depth_observed.abs_rel", reduce=statistics.fmean
        ),
        _make_geometry(
            "depth_hole", "AbsRel in holes", "depth_hole.abs_rel", reduce=statistics.fmean
        ),
        _make_geometry("depth_hole_median", "AbsRel in holes (median)", "depth_hole.abs_rel"),
    ),
    # All are medians over the cases; lengths are relative to the depth.
    "Geometry of added Gaussians": (
        replace(
            _make_median("depth_rim_median", "depth step at seam (median)", 4, "seam_step"),
            pixels="added.pixels",
        ),
        *_make_agreements("added", "to context", "align"),
    ),
    # The same after registration, before the hole filter.
    "Geometry of all lifted Gaussians": _make_agreements("registered", "of all lifted"),
    "Sequences": (
        PSNR_BEFORE,
        Column("psnr_end", "PSNR at the end", 2, "psnr_end"),
        Column("depth_scale", "depth scale", 3, "depth_scale"),
        Column("scale_drift", "scale drift", 3, "depth_scale", reduce_steps=compute_scale_drift),
    ),
}
"""Columns of the tables of every run by the title of their table; PSNR is in dB."""

PAPER = (
    *(
        _make_geometry(f"{key}{name}", f"{title}{of}", f"{path}.{name}", 4, statistics.fmean)
        for key, path, of in (("", "registered", ""), ("rim_", "added", " (rim)"))
        for name, title in (("abs_rel", "AbsRel"), ("chamfer", "Chamfer"), ("f_score", "F-score"))
    ),
    Column("fid", "FID", 2, "fid"),  # of all images at once, see `tables.compute_fids`
    Column("fallbacks", "FB", 0, "anchor_fallback", reduce_steps=sum, reduce_tasks=sum),
    Column("seconds", "total (s)", 2, "seconds.total"),
    *(Column(f"seconds_{s}", f"{s} (s)", 2, f"seconds.{s}") for s in STAGES),
)
"""Further columns of the paper's tables. All are means over cases but the sum of fallbacks. All
lifted Gaussians are compared with the context, and with "(rim)" those that are added."""

BY_KEY = {column.key: column for group in (*COLUMN_GROUPS.values(), PAPER) for column in group}
"""All columns by their key."""
