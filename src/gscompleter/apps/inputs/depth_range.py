"""Depth range of the photographs: known, that of a model, or measured."""

from __future__ import annotations

import math
from dataclasses import replace

from gscompleter.apps.inputs.task import CompletionTask
from gscompleter.reconstructors import Reconstructor, get_trained_range
from gscompleter.reconstructors.features.depth_range import (
    find_depth_range,
    measure_feature_depths,
    set_depth_range,
)
from gscompleter.render.protocols import Renderer
from gscompleter.stages.context import find_splat_range
from gscompleter.types import Gaussians


def apply_splat_range(task: CompletionTask, scene: Gaussians, renderer: Renderer) -> CompletionTask:
    """Set the depth range of the photographs of an input splat; it is measured if not known."""
    near, far = find_splat_range(task.views, scene, renderer)
    return replace(task, views=set_depth_range(task.views, near, far))


def apply_scene_range(task: CompletionTask, reconstructor: Reconstructor) -> CompletionTask:
    """Set the depth range of the photographs from which Ψ reconstructs the scene."""
    # A published network has the depth range of its authors (decision 047), which takes the place
    # of a range estimated from features.
    trained = get_trained_range(reconstructor)
    near, far = find_depth_range(task.views, trained)
    depths = dict(task.depths)
    if trained is not None:
        for name, source in task.depths.items():
            if source == "features":
                depths[name] = "model"
    return replace(task, views=set_depth_range(task.views, near, far), depths=depths)


def describe_range_mismatch(task: CompletionTask, reconstructor: Reconstructor) -> list[str]:
    """Say that the scene's features lie outside of the depths that Ψ was trained on.

    Published networks sweep planes between depths that their authors chose for scenes in metres. A
    scene in another unit, as of COLMAP, has its surfaces elsewhere, and the networks cannot see it.
    """
    trained = get_trained_range(reconstructor)
    if trained is None or "model" not in task.depths.values():
        return []
    depths = measure_feature_depths(task.views)
    if depths is None:
        return []
    nearest, farthest = depths
    near, far = trained
    # The geometric mean decides: the farthest features are often mismatches.
    middle = math.sqrt(nearest * farthest)
    if near <= middle <= far:
        return []
    return [
        f"The scene lies at depths from {nearest:.2g} to {farthest:.2g}, and this model was "
        f"trained on {near:g} to {far:g} (metres); scale the cameras to metres, or give --near "
        "and --far."
    ]
