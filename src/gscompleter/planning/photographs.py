"""Targets at the photographs' own cameras, which all look at what was photographed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from gscompleter.numerics.geometry import compute_spacing, select_spread_cameras, shrink_camera
from gscompleter.planning.candidates import Candidate
from gscompleter.planning.planner import Choice, SmallView, ViewPlanner
from gscompleter.render.removed import mask_removed
from gscompleter.render.view_map import get_view_map
from gscompleter.state import Completion
from gscompleter.types import Camera

MAX_SCORED_PHOTOGRAPHS = 64
"""Most photographs that are scored; of more, those far apart."""


@dataclass(frozen=True)
class PhotographPlanner(ViewPlanner):
    """Chooses targets among the cameras of photographs that show something removed."""

    def find_candidates(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> tuple[list[Candidate], float]:
        """Return the cameras as candidates, and their spacing; no surface is too close to them."""
        chosen = sorted(select_spread_cameras(cameras, MAX_SCORED_PHOTOGRAPHS))
        ranged = [completion.with_depth_range(cameras[index]) for index in chosen]
        propose = partial(self.propose, completion)
        candidates = list(get_view_map(completion.context.means)(propose, ranged, chosen))
        return candidates, compute_spacing(cameras)

    def score_candidate(
        self, completion: Completion, anchors: Sequence[SmallView], candidate: Candidate
    ) -> Choice:
        """Score one candidate; the less an image shows beside the hole, the less it gains."""
        choice = super().score_candidate(completion, anchors, candidate)
        return replace(choice, gain=choice.gain * (1 - choice.hole_fraction) ** 2)

    def propose(self, completion: Completion, camera: Camera, index: int) -> Candidate:
        """Make the candidate of a photograph."""
        small = shrink_camera(camera, completion.config.next_best_view.image_size)
        region = mask_removed(completion.source, small, self.completer.renderer)
        return Candidate(camera, index, 0.0, region)
