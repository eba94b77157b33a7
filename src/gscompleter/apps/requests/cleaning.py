"""Requests to take floaters out of a splat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gscompleter.apps.requests.completion import ResultsRequest
from gscompleter.apps.requests.scene import PhotographsRequest
from gscompleter.apps.requests.splat import SplatRequest
from gscompleter.config import CleaningConfig


@dataclass(frozen=True, kw_only=True)
class CleaningRequest:
    """Remove Gaussians that photographs do without, or that stand out from their neighbours."""

    splat: SplatRequest
    photographs: PhotographsRequest | None = None
    """Photographs of the splat, which it is compared with; None if neighbours decide."""
    strength: float = 1.0
    """How much goes, relative to `config`."""
    config: CleaningConfig = CleaningConfig()
    device: Literal["cpu", "cuda"] = "cpu"
    dry_run: bool = False
    """True to show only what would go."""
    results: ResultsRequest
