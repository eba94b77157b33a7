"""Memory that a completion needs, estimated from its input."""

from __future__ import annotations

from torch import Tensor

from gscompleter.apps.inputs.task import CompletionTask
from gscompleter.system.memory import check_bytes, estimate_bytes, estimate_scene_bytes
from gscompleter.types import Gaussians


def check_scene(task: CompletionTask, scene: Gaussians) -> None:
    """Refuse a splat that does not fit into memory together with its photographs."""
    photographs = len(task.views) + len(task.check_views or ())
    what = f"The {len(scene):,} Gaussians of the scene and {photographs} photographs"
    remedy = "crop the scene, or give a folder with fewer photographs"
    check_bytes(estimate_memory(task, scene), what, remedy)


def estimate_memory(task: CompletionTask, scene: Gaussians | None) -> int:
    """Estimate the bytes that a completion needs, with an input splat or without."""
    pixels = max(camera.width * camera.height for camera in task.cameras)
    needed = estimate_bytes(pixels, len(task.cameras))
    if scene is None:
        return needed

    # A splat is frozen for each photograph that guards it. Its memory grows with the numbers of a
    # Gaussian, most of which are spherical harmonics.
    cameras = [view.camera for view in (*task.views, *(task.check_views or ()))]
    parts = [part for part in vars(scene).values() if isinstance(part, Tensor)]
    numbers = sum(part[0].numel() for part in parts)
    sizes = [camera.width * camera.height for camera in cameras]
    return needed + estimate_scene_bytes(len(scene), numbers, sizes)
