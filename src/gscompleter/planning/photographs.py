"""Targets at the photographs' own cameras, to complete the place of something that was removed.

The photographs show that place, so that no camera beside them has to be searched for.
"""

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
"""Most photographs that are scored; of more, those that are farthest apart."""


@dataclass(frozen=True)
class PhotographPlanner(ViewPlanner):
    """Chooses targets among the cameras of photographs that show something removed."""

    def find_candidates(
        self, completion: Completion, cameras: Sequence[Camera]
    ) -> tuple[list[Candidate], float]:
        """Return cameras of photographs as candidates, and their spacing in scene units."""
        chosen = sorted(select_spread_cameras(cameras, MAX_SCORED_PHOTOGRAPHS))
        ranged = [completion.with_depth_range(cameras[index]) for index in chosen]
        propose = partial(self.propose, completion)
        map_views = get_view_map(completion.context.means)
        return list(map_views(propose, ranged, chosen)), compute_spacing(cameras)

    def score_candidate(
        self, completion: Completion, anchors: Sequence[SmallView], candidate: Candidate
    ) -> Choice:
        """Score one candidate; the larger its hole, the more of its gain is taken off.

        A hole that fills most of an image has little around it that says what it may be filled
        with. So the gain, which grows with the hole, is multiplied by the squared share of the rest
        and is largest for a hole of about a third of the image.
        """
        choice = super().score_candidate(completion, anchors, candidate)
        return replace(choice, gain=choice.gain * (1 - choice.hole_fraction) ** 2)

    def propose(self, completion: Completion, camera: Camera, index: int) -> Candidate:
        """Make the candidate of a photograph, whose `index` is that among all cameras.

        It may be completed where the photograph showed what was removed, and nowhere else.
        """
        small = shrink_camera(camera, completion.config.next_best_view.image_size)
        region = mask_removed(completion.source, small, self.completer.renderer)
        # A photograph was taken from there, so that no surface is too close: none is nearer than 0.
        return Candidate(camera, index, nearest=0.0, region=region)
