"""Growth of time and memory, as the exponent of a power law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gscompleter.apps.bench.samples import SampleSet


@dataclass(frozen=True)
class Growth:
    """Measurements along an axis."""

    axis: str
    sizes: tuple[int, ...]
    points: tuple[SampleSet, ...]
    """One for each size."""

    @property
    def exponents(self) -> dict[str, float | None]:
        """Exponent p of seconds ~ size^p by stage."""
        return {
            stage: fit_exponent(self.sizes, self.get_medians(stage))
            for stage in self.points[0].stages
        }

    @property
    def memory_exponent(self) -> float | None:
        """Exponent of the peak memory."""
        return fit_exponent(self.sizes, [float(point.peak_bytes or 0) for point in self.points])

    def get_medians(self, stage: str) -> list[float]:
        """Return the median seconds of a stage at each size."""
        return [point.seconds[stage].median for point in self.points]


def fit_exponent(sizes: Sequence[int], values: Sequence[float]) -> float | None:
    """Fit the exponent of a power law by least squares; None for fewer than two sizes."""
    known = [(size, value) for size, value in zip(sizes, values, strict=True) if value > 0]
    if len({size for size, _ in known}) < 2:
        return None
    x, y = np.log(np.array(known, dtype=np.float64)).T
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x * x).sum())
