"""Hull guard (not in the paper): nothing is added outside of an object that stands on nothing."""

from __future__ import annotations

from gscompleter.guards import Guard
from gscompleter.render.outside import find_in_hull, look_from_outside
from gscompleter.stages.target_view import TargetView
from gscompleter.types import Gaussians

SILHOUETTE_SIDE = 192
"""Width and height of the silhouettes, in pixels."""


class Hull(Guard):
    """Add nothing outside of the visual hull of the scene as it was given (decision 080)."""

    name = "hull"
    loss = "a filling would lie outside of the object"

    def place(self, candidates: Gaussians, view: TargetView) -> Gaussians:
        """Keep candidates that lie in the silhouettes of the scene from all sides."""
        # What a removal took out of the scene still counts, so that its place may be filled.
        given = view.state.source.gaussians
        silhouettes = look_from_outside(given, view.scenes.renderer, SILHOUETTE_SIDE)
        return candidates[find_in_hull(candidates, silhouettes)]
