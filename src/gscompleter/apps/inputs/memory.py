"""Memory that a completion needs, estimated from its input."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gscompleter.apps.inputs.task import CompletionTask
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.generators.patch_devices import estimate_patch_bytes
from gscompleter.numerics.geometry import is_inside, pad_camera, project
from gscompleter.reconstructors.plane_sweep.device_memory import estimate_sweep_bytes
from gscompleter.stages.add_observed import limit_part_photos
from gscompleter.system.files.mapping import is_mapped
from gscompleter.system.memory import (
    check_bytes,
    check_gpu_bytes,
    estimate_bytes,
    estimate_gpu_bytes,
    estimate_scene_bytes,
)
from gscompleter.types import Camera, Gaussians

NUM_SAMPLED = 100_000
"""Gaussians of which is counted what each photograph shows."""


def check_scene(task: CompletionTask, scene: Gaussians) -> None:
    """Raise InputError if a splat does not fit into memory together with its photographs.

    `scene` is the splat as it was read, before it becomes `task.scene`.
    """
    photographs = len(task.views) + len(task.check_views or ())
    what = f"The {len(scene):,} Gaussians of the scene and {photographs} photographs"
    remedy = "crop the scene, or give a folder with fewer photographs"
    check_bytes(estimate_memory(task, scene), what, remedy)


def check_gpu(task: CompletionTask, models: ModelRequest, margin: float) -> None:
    """Raise InputError if `task.scene` does not fit on the GPU together with its photographs.

    Images of targets are padded by `margin` of their size on every side.
    """
    assert task.scene is not None
    views = [*task.views, *(task.check_views or ())]
    cameras = [view.camera for view in views]
    # The embedded models run there one after the other.
    embedded = [0]
    if models.network_device == "cuda" and models.reconstructor == "plane-sweep":
        embedded.append(estimate_matching_bytes(cameras))
    if models.network_device == "cuda" and models.generator == "warp-inpaint":
        photographs = [view.camera for view in task.views]
        targets = [target.camera for target in task.targets] or photographs
        embedded.append(estimate_filling_bytes(photographs, targets, margin))
    needed = estimate_gpu_memory(task.scene, cameras, max(embedded))
    free, _ = torch.cuda.mem_get_info()
    what = f"The {len(task.scene):,} Gaussians of the scene and {len(views)} photographs"
    check_gpu_bytes(needed, free, what)


def estimate_matching_bytes(cameras: Sequence[Camera]) -> int:
    """Estimate the bytes that plane-sweep takes on a GPU for photographs that show what is lacking.

    All of them may do so, as far as they are reconstructed together. There is at least one camera.
    """
    sizes = sorted([(camera.height, camera.width) for camera in cameras], key=math.prod)
    number = limit_part_photos(math.prod(sizes[-1]))
    return estimate_sweep_bytes(sizes[-number:])


def estimate_filling_bytes(
    photographs: Sequence[Camera], targets: Sequence[Camera], margin: float
) -> int:
    """Estimate the bytes that warp-inpaint takes on a GPU for the target for which it is most."""
    sizes = [(camera.height, camera.width) for camera in photographs]
    padded = [pad_camera(target, margin).padded for target in targets]
    return max(estimate_patch_bytes(sizes, (camera.height, camera.width)) for camera in padded)


def estimate_gpu_memory(scene: Gaussians, cameras: Sequence[Camera], embedded: int = 0) -> int:
    """Estimate the bytes that a completion of a placed splat needs on a GPU.

    `cameras` are those of its photographs, at least one, and `embedded` bytes are those of the
    embedded Ψ or Φ there. The splat has Gaussians, as every file that is read does.
    """
    # Views on a GPU hold the Gaussians in their image, whatever hides them.
    means = scene.means[:: max(1, len(scene) // NUM_SAMPLED)]
    inside = [is_inside(*project(means, camera), camera).float().mean() for camera in cameras]
    shown = [round(len(scene) * share) for share in torch.stack(inside).tolist()]
    pixels = sum(camera.width * camera.height for camera in cameras)
    return estimate_gpu_bytes(len(scene), scene.sh.shape[1], shown, pixels, embedded)


def estimate_memory(task: CompletionTask, scene: Gaussians | None) -> int:
    """Estimate the bytes of main memory that a completion needs, with an input splat or without."""
    pixels = max(camera.width * camera.height for camera in task.cameras)
    needed = estimate_bytes(pixels, len(task.cameras))
    if scene is None:
        return needed

    # A splat is frozen for each photograph that guards it. Its memory grows with the numbers of a
    # Gaussian, most of which are spherical harmonics.
    cameras = [view.camera for view in (*task.views, *(task.check_views or ()))]
    parts = [part for part in vars(scene).values() if isinstance(part, Tensor)]
    numbers = sum(part[0].numel() for part in parts)
    num_filed = sum(part[0].numel() for part in parts if is_mapped(part))
    sizes = [camera.width * camera.height for camera in cameras]
    return needed + estimate_scene_bytes(len(scene), numbers, sizes, num_filed)
