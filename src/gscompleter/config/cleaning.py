"""Settings of `gscompleter clean`. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from gscompleter.config.settings import Settings, Weight


@dataclass(frozen=True)
class CleaningConfig(Settings):
    """Settings of the cleaning."""

    min_ratio: Annotated[float, Interval(ge=1, le=1e6)] = 4.0
    """Remove a Gaussian if some photographs gain this many times what the others lose without
    it."""
    idle: Weight = 1.0
    """Also remove a Gaussian if the photographs lose at most this many times an equal share of
    their error, spread over all visible Gaussians."""
    tolerance: Annotated[float, Interval(ge=0, le=10)] = 0.01
    """Largest loss of PSNR of a photograph by the whole cleaning, in dB."""
    probes: Annotated[int, Interval(ge=1, le=1000)] = 8
    """Number of random images for the estimate of a Gaussian's influence."""
