"""Removal guard (not in the paper): fill only the hole that removed Gaussians leave."""

from __future__ import annotations

from gscompleter.guards import Guard
from gscompleter.numerics.geometry import project_mask
from gscompleter.stages.target_view import TargetView
from gscompleter.types import Gaussians


class Removal(Guard):
    """Add nothing where the scene looked the same before the removal."""

    name = "removal"
    loss = "nothing was removed there"

    def place(self, candidates: Gaussians, view: TargetView) -> Gaussians:
        """Keep candidates in pixels that showed something removed."""
        opened = view.masks.edits.opened
        if opened is None:
            return candidates
        return candidates[project_mask(opened, candidates, view.camera.padded)]
