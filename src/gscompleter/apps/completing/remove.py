"""Removal of something from a splat, whose hole is completed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from rich.console import Console
from torch import Tensor

from gscompleter.apps.commands.remove import RemoveOptions
from gscompleter.apps.completing.preparation import Prepared, prepare_completion
from gscompleter.apps.inputs.removal import (
    Selection,
    check_removal_masks,
    check_selection,
    choose_gaussians,
    find_in_region,
    widen_regions,
)
from gscompleter.editing.removal import remove_gaussians
from gscompleter.planning.photographs import PhotographPlanner
from gscompleter.state import Completion
from gscompleter.system.progress import stage

SELECTIONS = ("box", "box_rotation", "sphere", "mask", "select")


@dataclass(frozen=True)
class PreparedRemoval(Prepared):
    """A completion that begins with the removal."""

    options: RemoveOptions

    @cached_property
    def selection(self) -> Selection:
        """The Gaussians to remove, as the options select them, with the margin of regions."""
        assert self.task.scene is not None
        return widen_regions(make_selection(self.options), self.task.scene, self.task.origin)

    def begin(self) -> Completion:
        """Initialize the context, and remove the selected Gaussians from it."""
        completer = self.completer
        # Before the context, so that a wrong selection is refused without waiting for it.
        with stage("removing"):
            chosen = choose_gaussians(
                self.selection, self.task, self.opened, self.cameras, completer.renderer
            )
        begun = super().begin()
        with stage("removing"):
            # Gaussians that reach out of a box or the sphere are cut at its border. Those that a
            # mask or a file selects go as a whole.
            return remove_gaussians(begun, chosen, self.contains, completer.scenes)

    def contains(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Find points, in the frame of the result, in the boxes and the sphere."""
        # The region is given in the coordinates of the file, which float32 may not resolve.
        origin = torch.from_numpy(self.task.origin).to(points.device)
        return find_in_region(points.double() + origin, self.selection)

    @property
    def command(self) -> str:
        """The command, for the record of edits."""
        return "remove"

    def describe_settings(self) -> dict[str, Any]:
        """Describe the settings, with the selection."""
        selection = {name: getattr(self.options, name) for name in SELECTIONS}
        # JSON has no paths.
        texts = {name: str(selection[name]) for name in ("mask", "select") if selection[name]}
        margin = {"margin": self.selection.margin}
        return {**super().describe_settings(), **selection, **texts, **margin}


def prepare_removal(options: RemoveOptions, console: Console) -> PreparedRemoval:
    """Open the scene, and load the models; targets are searched for among the photographs."""
    selection = make_selection(options)
    check_selection(selection)
    ready = prepare_completion(options, console, selection)
    # Of photographs they were checked as soon as these were opened.
    if options.mask is not None and options.lacks_photographs:
        names = [frame.name for frame in ready.opened.photographs.frames]
        check_removal_masks(options.mask, names, options.mark_reading)

    explorer = PhotographPlanner(ready.completer)
    return PreparedRemoval(**{**vars(ready), "explorer": explorer})


def make_selection(options: RemoveOptions) -> Selection:
    """Make the selection that the options describe."""
    return Selection(
        options.box,
        options.box_rotation,
        options.sphere,
        options.mask,
        options.select,
        options.drop_nonfinite,
        mask_reading=options.mark_reading,
    )
