"""Completion of what a user marked as wrong, which goes before its place is filled."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from rich.console import Console

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.completing.preparation import Prepared, prepare_completion
from gscompleter.apps.inputs.hole_kinds import pair_masks, read_marks
from gscompleter.data.mask_checks import check_selected_share, check_selecting_masks
from gscompleter.editing.marking import find_marked
from gscompleter.editing.removal import remove_gaussians
from gscompleter.planning.remove import contain_nothing
from gscompleter.state import Completion
from gscompleter.system.errors import InputError
from gscompleter.system.progress import stage


@dataclass(frozen=True)
class PreparedMarked(Prepared):
    """A completion that begins with the removal of what is marked."""

    def begin(self) -> Completion:
        """Initialize the context, and remove from it what the masks show."""
        task = self.task
        scene = task.scene
        assert scene is not None
        # All photographs share one depth range.
        known = task.views[0].camera
        cameras = [replace(c, near=known.near, far=known.far) for c in task.target_cameras]
        reading = self.options.mark_reading
        # Before the context, so that wrong masks are refused without waiting for it.
        with stage("removing"):
            pairs = pair_masks(self.options.marks, cameras)
            marks = [read_marks(path, camera, reading) for path, camera in pairs]
            chosen = find_marked(scene, cameras, marks, self.completer.renderer)
            check_selected_share(chosen.float().mean().item(), reading)
            if not chosen.any():
                raise InputError(
                    "The masks show no Gaussian of the splat; mark what the images of the targets "
                    "show, or leave --mask out where nothing is to be seen.",
                    "mask",
                )
        begun = super().begin()
        with stage("removing"):
            return remove_gaussians(begun, chosen, contain_nothing, self.completer.scenes)

    @property
    def command(self) -> str:
        """The command, for the record of edits."""
        return "repair"

    def describe_settings(self) -> dict[str, Any]:
        """Describe the settings, with the masks."""
        return {**super().describe_settings(), "mask": [str(path) for path in self.options.marks]}


def prepare_marked(options: CompleteOptions, console: Console) -> Prepared:
    """Open the scene, and load the models; with masks, what they show is removed first."""
    if not options.marks:
        return prepare_completion(options, console)
    check_marks(options)
    check_selecting_masks(options.marks, options.mark_reading, "the images of their cameras")
    ready = prepare_completion(options, console)
    # Before anything is rendered or removed.
    pair_masks(options.marks, ready.task.target_cameras)
    return PreparedMarked(**vars(ready))


def check_marks(options: CompleteOptions) -> None:
    """Refuse masks without a splat or without targets."""
    if options.scene is None and not options.lacks_photographs:
        raise InputError(
            "Without a splat there is nothing that masks could mark; name it with --scene.", "mask"
        )
    if not options.target:
        raise InputError(
            "A mask is painted on the image of a target; name the camera of each with --target.",
            "mask",
        )
