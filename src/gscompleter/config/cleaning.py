"""What cleaning takes out of a scene. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from gscompleter.config.settings import Settings, Weight


@dataclass(frozen=True)
class CleaningConfig(Settings):
    """What is taken out of a scene that was brought."""

    min_ratio: Annotated[float, Interval(ge=1, le=1e6)] = 4.0
    """A Gaussian goes where some photographs gain this many times what others lose without it."""
    idle: Weight = 1.0
    """A Gaussian goes, too, where the photographs lose no more than this many times an equal share
    of their error, spread over all Gaussians that they show."""
    tolerance: Annotated[float, Interval(ge=0, le=10)] = 0.01
    """Decibels that a photograph may lose by all that is taken out together."""
    probes: Annotated[int, Interval(ge=1, le=1000)] = 8
    """Random images by which it is estimated how far a Gaussian changes a photograph."""
