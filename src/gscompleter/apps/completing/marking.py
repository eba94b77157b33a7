"""Completion of what a user marked as wrong, which goes before its place is filled."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from rich.console import Console

from gscompleter.apps.completing.preparation import Marks, prepare_completion
from gscompleter.apps.completing.prepared import Gone, Prepared
from gscompleter.apps.completing.remove import choose_selected
from gscompleter.apps.inputs.hole_kinds import pair_masks, read_marks
from gscompleter.apps.inputs.removal import check_selection
from gscompleter.apps.requests.completion import RepairRequest
from gscompleter.apps.requests.splat import Selection
from gscompleter.data.mask_checks import check_selected_share, check_selecting_masks
from gscompleter.editing.marking import find_marked
from gscompleter.planning.remove import contain_nothing
from gscompleter.system.errors import InputError


def prepare_repair(request: RepairRequest, console: Console) -> Prepared:
    """Open the scene, and load the models; what is marked goes first."""
    if request.selection is not None:
        return prepare_selected(request, request.selection, console)
    check_selecting_masks(request.masks, request.reading, "the images of their cameras")
    marks = Marks(request.masks, request.reading)
    ready = prepare_completion(request.completion, console, marks)
    # Before anything is rendered or removed.
    pair_masks(request.masks, ready.task.target_cameras)
    return replace(
        ready,
        command=request.command,
        inverts_masks=request.reading.is_inverted,
        choose_gone=partial(choose_marked, request),
        settings={"mask": [str(path) for path in request.masks]},
    )


def prepare_selected(request: RepairRequest, selection: Selection, console: Console) -> Prepared:
    """Open the scene, and load the models; the selected Gaussians go first."""
    check_selection(selection)
    ready = prepare_completion(request.completion, console, Marks(selection=selection))
    return replace(
        ready,
        command=request.command,
        choose_gone=partial(choose_selected, selection),
        settings={"select": str(selection.file)},
    )


def choose_marked(request: RepairRequest, ready: Prepared) -> Gone:
    """Choose the Gaussians that the masks show."""
    task = ready.task
    scene = task.scene
    assert scene is not None
    # Targets are seen with the depth range of the photographs, which share one.
    photographed = task.views[0].camera
    cameras = [
        replace(camera, near=photographed.near, far=photographed.far)
        for camera in task.target_cameras
    ]
    pairs = pair_masks(request.masks, cameras)
    marks = [read_marks(path, camera, request.reading) for path, camera in pairs]
    chosen = find_marked(scene, cameras, marks, ready.completer.renderer)
    check_selected_share(chosen.float().mean().item(), request.reading)
    if not chosen.any():
        raise InputError(
            "The masks show no Gaussian of the splat; mark what the images of the targets show. "
            "Places where nothing is to be seen need no mask: `gscompleter complete` without "
            "--mask fills them.",
            "mask",
        )
    return Gone(chosen, contain_nothing)
