"""The command `remove`: take something out of a splat, and complete the hole that it leaves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.complete import CompleteOptions, choose_ending, decide_holes
from gscompleter.apps.commands.shared_decisions import check_splat_named
from gscompleter.apps.requests.completion import RemovalRequest, Request
from gscompleter.apps.requests.splat import Selection
from gscompleter.config import CompleterConfig
from gscompleter.data.mask_reading import MaskReading
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class RemoveOptions(CompleteOptions):
    """Remove something from a splat, and complete the hole that it leaves.

    What other photographs show behind it fills the hole, and the generator invents the rest.
    `gscompleter strip` gives the splat back as it was. Coordinates are those of the splat's file.

    Example: gscompleter remove photographs --scene splat.ply --mask masks --out removed
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """The splat; or the folder of its photographs, in any layout that `complete` reads, if
    `--scene` names the splat."""
    box: tuple[float, ...] = ()
    """Remove Gaussians inside of boxes: smallest x, y and z of each, then largest."""
    box_rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Rotation of the boxes about their centres, as a quaternion w x y z."""
    sphere: tuple[float, float, float, float] | None = None
    """Remove Gaussians inside of a sphere: x, y, z of its centre, and its radius."""
    mask: Path | None = None  # type: ignore[assignment]  # one folder, and not files by target
    """Masks of what goes, white there. A folder of images named as photographs; if the object is
    cut out, what is opaque goes."""
    select: Path | None = None
    """Remove the Gaussians of this file, a selection that another program saved."""


def decide_removal(options: RemoveOptions) -> Request:
    """Decide what is removed, and how its hole is filled."""
    check_splat_named(options, "removed")
    reading = MaskReading(options.invert_masks, options.large_masks)
    # With masks of what goes, `--invert-masks` is for them instead of for masks of photographs.
    has_marks = options.mask is not None
    completion = decide_holes(options, has_marks, CompleterConfig.for_removal)
    # Masks of what goes may lie beside photographs, where masks of what to ignore are looked for.
    source = completion.source
    scene = replace(source.scene, removal_masks=options.mask, removal_reading=reading)
    completion = replace(completion, source=replace(source, scene=scene))
    selection = Selection(
        options.box,
        options.box_rotation,
        options.sphere,
        options.mask,
        options.select,
        options.drop_nonfinite,
        mask_reading=reading,
    )
    return choose_ending(options, RemovalRequest(completion, selection))


def run_remove(options: RemoveOptions) -> int:
    """Remove the selection, complete the hole, and print a summary; exit codes as of `complete`."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.completing.complete import run_request
    return run_request(decide_removal(options))
