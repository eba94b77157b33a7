"""Depth range of the photographs: known, that of a model, or measured."""

from __future__ import annotations

from dataclasses import replace

from gscompleter.apps.inputs.task import CompletionTask
from gscompleter.reconstructors import Reconstructor, get_trained_range
from gscompleter.reconstructors.features.depth_range import set_depth_range
from gscompleter.reconstructors.scene_range import find_scene_range
from gscompleter.render.protocols import Renderer
from gscompleter.stages.context import find_splat_range
from gscompleter.types import Gaussians


def apply_splat_range(task: CompletionTask, scene: Gaussians, renderer: Renderer) -> CompletionTask:
    """Set the depth range of the photographs of an input splat; it is measured if not known.

    `task.depths` names the splat as its source from the beginning (`find_depth_sources`).
    """
    near, far = find_splat_range(task.views, scene, renderer)
    return replace(task, views=set_depth_range(task.views, near, far))


def apply_scene_range(
    task: CompletionTask, reconstructor: Reconstructor
) -> tuple[CompletionTask, tuple[str, ...]]:
    """Set the depth range of the photographs from which Ψ reconstructs the scene.

    Also returns sentences about what contradicts a range that was given. The context stage takes
    this range as it is (`Prepared.begin`).
    """
    # A published network has the depth range of its authors (decision 047), which takes the place
    # of a range estimated from features.
    trained = get_trained_range(reconstructor)
    found = find_scene_range(reconstructor, task.views)
    # All photographs of a task have the same planes.
    camera = task.views[0].camera
    depths = dict(task.depths)
    for name, before, after in (
        ("near", camera.near, found.near),
        ("far", camera.far, found.far),
    ):
        if before is None and trained is not None:
            depths[name] = "model"
        elif before != after:
            depths[name] = "features"
    views = set_depth_range(task.views, found.near, found.far)
    return replace(task, views=views, depths=depths), found.notes
