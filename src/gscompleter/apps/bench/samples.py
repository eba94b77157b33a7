"""Measurements and their statistics."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Spread:
    """Statistics of several measurements of one quantity."""

    median: float
    low: float
    high: float

    @staticmethod
    def from_values(values: Sequence[float]) -> Spread:
        """Compute the statistics of values."""
        return Spread(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Sample:
    """One measurement."""

    seconds: Mapping[str, float]
    """Wall time by stage."""
    yardstick: float
    """Seconds of the yardstick, the mean of just before and just after."""
    peak_bytes: int | None = None
    """Peak memory, or None if the system does not report it."""
    gaussians: Mapping[str, int] = field(default_factory=dict)
    """Numbers of Gaussians in the context and added."""

    @property
    def ratios(self) -> dict[str, float]:
        """Wall time by stage, in yardsticks."""
        return {stage: seconds / self.yardstick for stage, seconds in self.seconds.items()}


@dataclass(frozen=True)
class SampleSet:
    """All samples of one case or method."""

    name: str
    samples: tuple[Sample, ...]

    @property
    def seconds(self) -> dict[str, Spread]:
        """Wall time by stage."""
        return {s: Spread.from_values([x.seconds[s] for x in self.samples]) for s in self.stages}

    @property
    def ratios(self) -> dict[str, Spread]:
        """Wall time by stage, in yardsticks."""
        return {s: Spread.from_values([x.ratios[s] for x in self.samples]) for s in self.stages}

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages."""
        return tuple(self.samples[0].seconds)

    @property
    def peak_bytes(self) -> int | None:
        """Largest peak memory, or None if unknown."""
        known = (s.peak_bytes for s in self.samples if s.peak_bytes is not None)
        return max(known, default=None)

    @property
    def gaussians(self) -> Mapping[str, int]:
        """Numbers of Gaussians of the first sample; the seed makes all samples equal."""
        return self.samples[0].gaussians
