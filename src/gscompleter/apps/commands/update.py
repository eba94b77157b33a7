"""The command `update`: add to a splat what its photographs show and it lacks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Interval

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.shared_options import ReconstructorOptions, SceneOptions
from gscompleter.config import CompleterConfig
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class PhotographsOnlyOptions(CompleteOptions):
    """Options of the completion that an update is: nothing is invented, and there are no targets.

    On the command line `complete` has no such option: `update` is the one way to it, and looks at
    all photographs.
    """

    @property
    def from_photographs_only(self) -> bool:
        """True: nothing is invented."""
        return True

    @property
    def max_targets(self) -> int:
        """No target is searched for."""
        return 0


@dataclass(frozen=True, kw_only=True)
class UpdateOptions(SceneOptions, ReconstructorOptions):
    """Add to a splat what its photographs show and it lacks, and correct what they contradict.

    Nothing is invented. The report shows every photograph before and after.

    Example: gscompleter update photographs --scene splat.ply --out updated
    """

    scene: Path = field()  # without the default of `complete`
    """File of Gaussians (a splat) to work on. All are kept."""
    photos: Path | None = None
    """Folder of new photographs without cameras. COLMAP places them among those of SCENE, whose
    cameras stay as they are; the new cameras are kept in OUT/colmap."""
    hold_out: Annotated[int, Interval(ge=0, le=1000)] = 0
    """Number of photographs to keep back, at even steps: of `--photos`, or else of SCENE. They are
    not used, and the report compares the splat with them."""
    no_recolor: bool = False
    """Keep the colours of the splat, too; Gaussians are only added."""
    config: Annotated[CompleterConfig, tyro.conf.FlagConversionOff] = CompleterConfig()
    """Settings of the method, which change those of `--config NAME`."""

    def make_completion(self) -> PhotographsOnlyOptions:
        """Make the options of the completion without targets that an update is."""
        shared = {**vars(self)}
        for name in ("photos", "hold_out"):
            del shared[name]
        return PhotographsOnlyOptions(**shared)


def run_update(options: UpdateOptions) -> int:
    """Update the splat, and print a summary; exit codes as of `complete`."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.completing.update import update_splat
    return update_splat(options)
