"""Targets at the photographs' own cameras, which all look at what was photographed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gscompleter.geometry import compute_spacing, select_spread_cameras
from gscompleter.next_best_view.candidates import Candidate
from gscompleter.next_best_view.planner import ViewPlanner
from gscompleter.state import Completion
from gscompleter.types import Camera

MAX_CANDIDATES = 64
"""Most photographs that are scored; of more, those far apart."""


@dataclass(frozen=True)
class PhotographPlanner(ViewPlanner):
    """Chooses targets among the photographs' cameras."""

    def find_candidates(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> tuple[list[Candidate], float]:
        """Return the cameras as candidates, and their spacing; no surface is too close to them."""
        chosen = sorted(select_spread_cameras(cameras, MAX_CANDIDATES))
        found = [Candidate(completion.with_depth_range(cameras[i]), i, 0.0) for i in chosen]
        return found, compute_spacing(cameras)
