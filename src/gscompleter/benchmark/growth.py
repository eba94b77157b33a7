"""How times and memory grow: the slope of a straight line between logarithms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gscompleter.benchmark.samples import Measured


@dataclass(frozen=True)
class Growth:
    """A series of measurements along an axis."""

    axis: str
    sizes: tuple[int, ...]
    points: tuple[Measured, ...]
    """One for each size."""

    @property
    def slopes(self) -> dict[str, float | None]:
        """By stage, the exponent p of seconds ~ size^p."""
        return {stage: slope(self.sizes, self.medians(stage)) for stage in self.points[0].stages}

    @property
    def memory_slope(self) -> float | None:
        """The exponent of the peak of memory."""
        return slope(self.sizes, [float(point.peak_bytes or 0) for point in self.points])

    def medians(self, stage: str) -> list[float]:
        """Seconds of a stage at each size."""
        return [point.seconds[stage].median for point in self.points]


def slope(sizes: Sequence[int], values: Sequence[float]) -> float | None:
    """The slope of the least-squares line through the logarithms of both; None of fewer than two
    sizes with a value above zero."""
    known = [(size, value) for size, value in zip(sizes, values, strict=True) if value > 0]
    if len({size for size, _ in known}) < 2:
        return None
    x, y = np.log(np.array(known, dtype=np.float64)).T
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x * x).sum())
