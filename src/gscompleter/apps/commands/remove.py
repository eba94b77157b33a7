"""The command `remove`: take something out of a splat, and complete the hole that it leaves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.inputs.scene_request import SceneRequest
from gscompleter.config import CompleterConfig
from gscompleter.system.process import import_without_collection

REMOVAL_CONFIG = CompleterConfig.splat().for_removal()


@dataclass(frozen=True, kw_only=True)
class RemoveOptions(CompleteOptions):
    """Remove something from a splat, and complete the hole that it leaves.

    What other photographs show behind it fills the hole, and the generator invents the rest.
    `gscompleter strip` gives the splat back as it was. Coordinates are those of the splat's file.

    Example: gscompleter remove photographs --scene splat.ply --mask masks --out removed
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """Folder of the photographs of the splat, in any layout that `complete` reads; leave it out if
    there are none."""
    scene: Path = field()  # without the default of `complete`
    """File of Gaussians (a splat) to work on."""
    box: tuple[float, ...] = ()
    """Remove Gaussians inside of boxes: smallest x, y and z of each, then largest."""
    box_rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Rotation of the boxes about their centres, as a quaternion w x y z."""
    sphere: tuple[float, float, float, float] | None = None
    """Remove Gaussians inside of a sphere: x, y, z of its centre, and its radius."""
    mask: Path | None = None  # type: ignore[assignment]
    """Masks of what goes, white there. A folder of images named as photographs; if the object is
    cut out, what is opaque goes."""
    select: Path | None = None
    """Remove the Gaussians of this file, a selection that another program saved."""
    config: Annotated[CompleterConfig, tyro.conf.FlagConversionOff] = REMOVAL_CONFIG
    """Settings of the method, which change those of `--config NAME`."""

    @property
    def marks(self) -> tuple[Path, ...]:
        """No masks of targets: here they select what goes."""
        return ()

    def make_scene_request(self) -> SceneRequest:
        """Make the request for the photographs, of which masks of the removal hide nothing."""
        request = super().make_scene_request()
        return replace(request, removal_masks=self.mask, removal_reading=self.mark_reading)

    @property
    def has_marks(self) -> bool:
        """True if masks say what goes, which `--invert-masks` then turns."""
        return self.mask is not None


def run_remove(options: RemoveOptions) -> int:
    """Remove the selection, complete the hole, and print a summary; exit codes as of `complete`."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.completing.complete import complete_scene
        from gscompleter.apps.completing.remove import prepare_removal
    return complete_scene(options, prepare_removal)
