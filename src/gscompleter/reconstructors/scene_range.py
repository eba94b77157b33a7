"""The depth range of the photographs from which Ψ reconstructs a scene."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.reconstructors import (
    NearPlaneFinder,
    Reconstructor,
    get_trained_range,
    keeps_given_range,
)
from gscompleter.reconstructors.features.depth_range import get_given_range
from gscompleter.reconstructors.features.given_range import DepthRange, find_depth_range
from gscompleter.system.errors import format_rounded
from gscompleter.types import View


def find_scene_range(reconstructor: Reconstructor, views: Sequence[View]) -> DepthRange:
    """Find near and far z-depth of the photographs from which Ψ reconstructs the scene."""
    keeps = keeps_given_range(reconstructor)
    views = [view.to("cpu") for view in views]  # copied from a GPU once for all that follows
    found = find_depth_range(views, get_trained_range(reconstructor), keeps)
    if keeps or not isinstance(reconstructor, NearPlaneFinder):
        return found
    near = reconstructor.find_near_plane(views, found.near, found.far)
    notes = found.notes
    is_given = found.near == get_given_range(views)[0]
    if is_given and near < found.near:
        note = (
            "Surfaces of the photographs stand nearer than the near plane at "
            f"{format_rounded(found.near)}: the depth range was widened to "
            f"{format_rounded(near, 2)} to {format_rounded(found.far)}."
        )
        notes = (*notes, note)
    return DepthRange(near, found.far, notes)
