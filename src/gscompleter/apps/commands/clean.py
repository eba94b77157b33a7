"""The command `clean`: remove floaters from a splat."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Interval

from gscompleter.apps.commands.shared_decisions import (
    check_context,
    decide_photographs,
    decide_results,
    decide_splat,
)
from gscompleter.apps.commands.shared_options import ChosenPhotographs, DeviceOptions, SceneOptions
from gscompleter.apps.requests.cleaning import CleaningRequest
from gscompleter.config import CleaningConfig, FloaterConfig
from gscompleter.system.errors import InputError
from gscompleter.system.process import import_without_collection

OPTIONS_OF_PHOTOGRAPHS = (
    "context",
    "format",
    "frames",
    "resolution",
    "near",
    "far",
    "no_given_depth",
    "no_refine_poses",
    "no_masks",
    "invert_masks",
    "large_masks",
    "ignore",
    "forget_edits",
)
"""Options that only photographs can follow. Some are those of renders as well, which take the place
of photographs in `complete`, but not here."""
NEEDS_PHOTOGRAPHS = "There are no photographs to apply this to; name their SCENE."
"""Sentence about such an option, or a setting, where there are none."""

Strength = Annotated[float, Interval(ge=0.1, le=10)]


@dataclass(frozen=True, kw_only=True)
class CleanOptions(SceneOptions, DeviceOptions):
    """Remove Gaussians of a splat that make its photographs worse or that none of them needs.

    No photograph loses more than 0.01 dB (times --strength). Without SCENE, remove those that stand
    out from their neighbours (isolated, huge, needles, transparent) and long streaks beside which
    nothing lies. The cleaned splat is OUT/completed.ply; removed.png shows what went, and
    `gscompleter strip` puts all back.

    Example: gscompleter clean photographs --scene splat.ply --out cleaned
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None  # type: ignore[assignment]
    """Folder of the photographs of the splat, in any layout that `complete` reads; if not given,
    neighbours decide."""
    out: Path
    """Write results here. A folder, for completed.ply (the cleaned splat), removed.ply, removed.png
    and summary.json."""
    scene: Path
    """File of Gaussians (a splat) to work on. It is cleaned."""
    context: ChosenPhotographs = None
    """Photographs to work with: file names, or numbers from 0 in the order of the file paths. The
    splat is compared with them; all of them if not given."""
    dry_run: bool = False
    """Only show what would be done. removed.ply has the Gaussians that would go, and removed.png
    shows them in red; summary.json is written, too."""
    strength: Strength = 1.0
    """How much goes: 2 takes more than 1, and 0.5 less. Look at it with --dry-run."""
    config: CleaningConfig = CleaningConfig()


def decide_cleaning(options: CleanOptions) -> CleaningRequest:
    """Decide which splat is cleaned, by photographs or without."""
    from gscompleter.render.device import choose_device  # no help page waits for torch

    check_context(options.context)
    if options.folder is None:
        defaults = {field.name: field.default for field in fields(options)}
        for name in OPTIONS_OF_PHOTOGRAPHS:
            if getattr(options, name) != defaults[name]:
                raise InputError(NEEDS_PHOTOGRAPHS, name)
    refuse_unused_settings(options.config, options.folder is not None)
    photographs = None
    if options.folder is not None:
        photographs = decide_photographs(options, options.folder)
    return CleaningRequest(
        splat=decide_splat(options, options.scene),
        photographs=photographs,
        strength=options.strength,
        config=options.config,
        device=choose_device(options.device),
        dry_run=options.dry_run,
        results=decide_results(options),
    )


def refuse_unused_settings(config: CleaningConfig, has_photographs: bool) -> None:
    """Refuse settings that nothing would read, instead of ignoring them.

    Photographs decide by all settings but `floaters`. Without them neighbours decide, by `floaters`
    alone.
    """
    usual = CleaningConfig()
    if has_photographs:
        for field in fields(FloaterConfig):
            if getattr(config.floaters, field.name) != getattr(usual.floaters, field.name):
                raise InputError(
                    "Photographs decide what goes, and neighbours only without them; leave it or "
                    "SCENE out.",
                    f"config.floaters.{field.name.replace('_', '-')}",
                )
        return
    for field in fields(CleaningConfig):
        name = field.name
        if name != "floaters" and getattr(config, name) != getattr(usual, name):
            raise InputError(NEEDS_PHOTOGRAPHS, f"config.{name.replace('_', '-')}")


def run_clean(options: CleanOptions) -> None:
    """Clean the splat, write the result, and print a summary."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.cleaning import clean_splat
    clean_splat(decide_cleaning(options))
