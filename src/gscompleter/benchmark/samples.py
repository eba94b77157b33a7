"""Measurements, and what several of the same come to."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Spread:
    """Several measurements of one quantity."""

    median: float
    low: float
    """The smallest of them."""
    high: float
    """The largest of them."""

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        return Spread(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Sample:
    """What something took once."""

    seconds: Mapping[str, float]
    """Wall time by stage."""
    yardstick: float
    """Seconds of the yardstick beside it, the mean of just before and just after."""
    peak_bytes: int | None = None
    """The most memory that was held; None where the system does not tell."""
    gaussians: Mapping[str, int] = field(default_factory=dict)
    """How many the scene had, and how many were added."""

    @property
    def ratios(self) -> dict[str, float]:
        """Wall time by stage, in yardsticks."""
        return {stage: seconds / self.yardstick for stage, seconds in self.seconds.items()}


@dataclass(frozen=True)
class Measured:
    """All samples of one case, or of one method."""

    name: str
    samples: tuple[Sample, ...]

    @property
    def seconds(self) -> dict[str, Spread]:
        """Wall time by stage."""
        return {s: Spread.of([x.seconds[s] for x in self.samples]) for s in self.stages}

    @property
    def ratios(self) -> dict[str, Spread]:
        """Wall time by stage, in yardsticks."""
        return {s: Spread.of([x.ratios[s] for x in self.samples]) for s in self.stages}

    @property
    def stages(self) -> tuple[str, ...]:
        return tuple(self.samples[0].seconds)

    @property
    def peak_bytes(self) -> int | None:
        """The most memory that any of them took; None where no system told."""
        known = (s.peak_bytes for s in self.samples if s.peak_bytes is not None)
        return max(known, default=None)

    @property
    def gaussians(self) -> Mapping[str, int]:
        """Those of the first; the same seed adds as many each time."""
        return self.samples[0].gaussians
