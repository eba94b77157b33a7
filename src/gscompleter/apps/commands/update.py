"""The command `update`: add to a splat what its photographs show and it lacks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Interval

from gscompleter.apps.command_line.chosen_config import ChosenConfig
from gscompleter.apps.command_line.named_splat import names_splat
from gscompleter.apps.commands.shared_decisions import (
    check_context,
    decide_models,
    decide_photographs,
    decide_results,
    decide_splat,
    make_two_splats_error,
    stop_recoloring,
)
from gscompleter.apps.commands.shared_options import (
    GeometryOptions,
    ReconstructorOptions,
    SceneOptions,
)
from gscompleter.apps.requests.completion import UpdateRequest, WorkRequest
from gscompleter.config.generators import GeneratorOptions
from gscompleter.system.errors import InputError
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class UpdateOptions(SceneOptions, ReconstructorOptions, GeometryOptions):
    """Add to a splat what its photographs show and it lacks, and correct what they contradict.

    Nothing is invented. The report shows every photograph before and after.

    Example: gscompleter update photographs --scene splat.ply --out updated
    """

    scene: Path = field()  # without the default of `complete`
    """File of Gaussians (a splat) to work on. All are kept, but what earlier commands added gives
    way where photographs show something else."""
    photos: Path | None = None
    """Folder of new photographs without cameras. COLMAP places them among those of SCENE, whose
    cameras stay as they are; the new cameras are kept in OUT/colmap."""
    hold_out: Annotated[int, Interval(ge=0, le=1000)] = 0
    """Number of photographs to keep back, at even steps: of `--photos`, or else of SCENE. They are
    not used, and the report compares the splat with them."""
    no_recolor: bool = False
    """Keep the colours of the splat, too; Gaussians are only added."""
    config: Annotated[ChosenConfig, tyro.conf.FlagConversionOff] = ChosenConfig()
    """Settings of the method, which change those of `--config NAME`."""


def decide_update(options: UpdateOptions) -> UpdateRequest:
    """Decide which splat is updated, by which photographs."""
    check_context(options.context)
    if names_splat(options.folder):
        raise make_two_splats_error(options.folder, options.scene)
    config = options.config.decide(is_splat=True, has_photographs=True)
    if not config.add_observed:
        raise InputError(
            "With config.add_observed off nothing is added from photographs, as in the config "
            "paper; choose another config.",
            "config",
        )
    config = stop_recoloring(config) if options.no_recolor else config
    # A request names a generator; it is not asked, since there are no targets.
    models = decide_models(options, GeneratorOptions())
    splat = decide_splat(options, options.scene)
    return UpdateRequest(
        source=decide_photographs(options, options.folder),
        work=WorkRequest(splat=splat, geometry=options.geometry, models=models, config=config),
        photos=options.photos,
        hold_out=options.hold_out,
        results=decide_results(options),
    )


def run_update(options: UpdateOptions) -> int:
    """Update the splat, and print a summary; exit codes as of `complete`."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.completing.complete import run_request
    return run_request(decide_update(options))
