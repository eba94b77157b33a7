"""Favour the photographs near the targets in a joint fit.

Photographs of one surface differ by exposure, reflections, and errors of depth and pose. Fitted to
all of them alike, a scene shows their mean, which is right at none (decision 143).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gscompleter.numerics.geometry import measure_distances
from gscompleter.types import Camera, View

NUM_REFINED = 3
"""Number of photographs nearest to a target that get further steps."""
NUM_FAVORED = 5
"""Number of photographs nearest to a target whose colours count whole."""
FAR_WEIGHT = 0.2
"""Weight of the colours of all others."""


@dataclass(frozen=True)
class Emphasis:
    """Check views and targets of a joint fit, beside the photographs that the scene comes from."""

    check_views: Sequence[View] = ()
    """Photographs that no Gaussian comes from, and to which the scene is fitted, too."""
    targets: Sequence[Camera] = ()
    """Cameras from which the scene will be looked at; without any, all photographs are alike."""

    def find_refined(self, views: Sequence[View]) -> list[int]:
        """Find the views that get further steps, in ascending order."""
        return find_nearest_views(self.targets, views, NUM_REFINED)

    def weigh_colors(self, views: Sequence[View]) -> list[float]:
        """Weigh the colours of each view."""
        if not self.targets:
            return [1.0] * len(views)
        favored = set(find_nearest_views(self.targets, views, NUM_FAVORED))
        return [1.0 if number in favored else FAR_WEIGHT for number in range(len(views))]


def find_nearest_views(targets: Sequence[Camera], views: Sequence[View], count: int) -> list[int]:
    """Find the numbers of the `count` views nearest to each target; in ascending order."""
    cameras = [view.camera for view in views]
    nearest: set[int] = set()
    for target in targets:
        order = measure_distances(cameras, [target]).argsort(stable=True)
        nearest.update(order[:count].tolist())
    return sorted(nearest)
