"""Contribution guard (not in the paper): drop additions that no image shows."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.guards import Attempt, Guard
from gscompleter.render.protocols import FrozenScene
from gscompleter.types import Gaussians

MIN_CONTRIBUTION = 0.002
"""Summed compositing weight up to which no pixel shows a Gaussian by more than this share."""


class Contribution(Guard):
    """Drop added Gaussians that are hidden, transparent or outside of every image."""

    name = "contribution"
    loss = "a filling would hardly be seen"

    def verify(self, added: Gaussians, attempt: Attempt) -> Gaussians:
        """Keep what the target or a photograph shows."""
        view = attempt.view
        shown = torch.zeros(len(added), dtype=torch.bool, device=added.means.device)
        for frozen in (view.frozen, *view.frozen_photos):
            shown |= find_shown(added, frozen)
        return added[shown]


def find_shown(added: Gaussians, frozen: FrozenScene) -> Bool[Tensor, "n"]:
    """Find Gaussians with enough summed weight in the image of a frozen scene."""
    # The weights do not depend on the colours that are fitted, so any colours and image will do.
    _, sums = frozen.vary_colors(added)(torch.zeros_like(added.means), frozen.render.image)
    return sums > MIN_CONTRIBUTION
