"""Removal of something from a splat in Python, with the completion of its place.

The command `remove` does the same with a choice by boxes, masks or a file (`apps.completing`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.completer import GSCompleter
from gscompleter.config import CompleterConfig
from gscompleter.editing.cutting import Region
from gscompleter.editing.removal import remove_gaussians, restore_surroundings
from gscompleter.numerics.value_checks import check_gaussians
from gscompleter.planning.photographs import PhotographPlanner
from gscompleter.state import Completion
from gscompleter.system.errors import InputError
from gscompleter.system.progress import show_in_notebook, stage
from gscompleter.system.tensor_checks import describe
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import Camera, Gaussians, View

MAX_REMOVAL_TARGETS = 4
"""Most photographs for which the place is completed if no targets are named."""


@show_in_notebook()
@run_in_plain_torch
def remove(
    scene: Gaussians,
    chosen: Bool[Tensor, "n"],
    views: Sequence[View],
    targets: Sequence[Camera] = (),
    completer: GSCompleter | None = None,
    contains: Region | None = None,
) -> Completion:
    """Remove Gaussians from a scene, and complete the hole that they leave.

    Args:
        scene: Gaussians in the frame and unit of the cameras.
        chosen: Mask of the Gaussians to remove.
        views: Posed photographs or renders of the scene; they still show what goes.
        targets: Cameras to complete the place for. If there are none, up to four are chosen among
            those of `views`, as `PhotographPlanner` does.
        completer: Models and settings, by default those of an input splat. As in the command,
            `CompleterConfig.for_removal` adapts them, so that nothing but the hole is completed.
        contains: Function from points [n, 3] to True for those in a region. Gaussians that reach
            out of it are cut at its border; if None, they go as a whole.

    Returns:
        The completion. `save(splat=...)` also writes what went: chosen Gaussians, and those behind
        them that no photograph showed.

    Raises:
        InputError: Nothing or everything is chosen, or as in `GSCompleter`.
    """
    completer = completer or GSCompleter()
    config = completer.config or CompleterConfig.splat()
    completer = replace(completer, config=config.for_removal())
    check_gaussians(scene, "The scene")
    is_mask = isinstance(chosen, Tensor) and chosen.dtype == torch.bool
    if not is_mask or chosen.shape != (len(scene),):
        raise InputError(
            f"What is chosen has to be a mask of the {len(scene)} Gaussians, of bool, and is "
            f"{describe(chosen)}."
        )
    if not chosen.any():
        raise InputError("No Gaussian is chosen; set the mask for those that have to go.")
    begun = completer.begin(views, scene, targets=targets)
    # The photographs that still show the object are masked there as well.
    with stage("removing"):
        begun = remove_gaussians(begun, chosen, contains or contain_nothing, completer.scenes)
    if targets:
        completion = completer.complete(begun, targets)
    else:
        cameras = [view.camera for view in views]
        planner = PhotographPlanner(completer)
        completion, _choices = planner.explore(begun, cameras, MAX_REMOVAL_TARGETS)
    # What was removed behind the object returns where photographs need it.
    return restore_surroundings(completion, completer.scenes)


def contain_nothing(points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Return False for all points: what is chosen goes as a whole, and nothing is cut."""
    return torch.zeros(len(points), dtype=torch.bool, device=points.device)
