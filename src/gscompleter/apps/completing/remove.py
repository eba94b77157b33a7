"""Removal of something from a splat, whose hole is completed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from rich.console import Console

from gscompleter.apps.completing.preparation import prepare_completion
from gscompleter.apps.completing.prepared import Gone, Prepared
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.inputs.removal import (
    check_removal_masks,
    check_selection,
    contain_points,
    describe_masks_in_vain,
    describe_parts_in_vain,
    select_with_masks,
    widen_regions,
)
from gscompleter.apps.requests.completion import RemovalRequest
from gscompleter.apps.requests.splat import Selection
from gscompleter.planning.photographs import PhotographPlanner


def prepare_removal(request: RemovalRequest, console: Console) -> Prepared:
    """Open the scene, and load the models; targets are searched for among the photographs."""
    selection = request.selection
    check_selection(selection)
    ready = prepare_completion(request.completion, console, place=selection)
    # Masks of photographs were checked when these were opened. Cameras of renders have names only
    # now.
    photographs = ready.opened.photographs
    if selection.masks is not None and ready.opened.renders_from is not None:
        names = [frame.name for frame in photographs.frames]
        check_removal_masks(selection.masks, names, photographs.files, selection.mask_reading)
    if selection.masks is not None:
        unused = describe_masks_in_vain(photographs, ready.cameras, selection.masks)
        print_lines(console, *unused)

    # The request of a removal names a splat.
    scene = ready.task.scene
    assert scene is not None
    widened = widen_regions(selection, scene, ready.task.splat_origin)
    print_lines(console, *describe_parts_in_vain(widened, scene, ready.task.splat_origin))
    return replace(
        ready,
        command=request.command,
        explorer=PhotographPlanner(ready.completer),
        inverts_masks=selection.mask_reading.is_inverted,
        choose_gone=partial(choose_selected, widened),
        settings=describe_selection(widened),
    )


def choose_selected(selection: Selection, ready: Prepared) -> Gone:
    """Choose the selected Gaussians."""
    chosen = select_with_masks(
        selection, ready.task, ready.opened, ready.cameras, ready.completer.renderer
    )
    # Gaussians that reach out of a box or the sphere are cut at its border. Those that a mask or a
    # file selects go as a whole.
    return Gone(chosen, partial(contain_points, selection, ready.task.splat_origin))


def describe_selection(selection: Selection) -> dict[str, Any]:
    """Describe a selection for `summary.json`, with the margin of its regions."""
    # JSON has no paths.
    return {
        "box": selection.boxes,
        "box_rotation": selection.box_rotation if selection.boxes else None,
        "sphere": selection.sphere,
        "mask": selection.masks and str(selection.masks),
        "select": selection.file and str(selection.file),
        "margin": selection.margin,
    }
