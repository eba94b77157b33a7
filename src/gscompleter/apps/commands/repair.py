"""The command `repair`: take what is wrong out of a splat, and fill its place.

What is wrong is named in one of three ways: by masks at cameras, by a selection of Gaussians, or by
the strokes of a session of `live`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.shared_decisions import (
    check_context,
    check_generator,
    check_splat_named,
    decide_filling,
    decide_results,
)
from gscompleter.apps.commands.shared_options import CompletingOptions
from gscompleter.apps.requests.completion import RepairRequest, TargetRequest
from gscompleter.apps.requests.splat import Selection
from gscompleter.config import CompleterConfig
from gscompleter.data.mask_reading import MaskReading
from gscompleter.system.errors import InputError
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class RepairOptions(CompletingOptions):
    """Take what masks or a selection mark out of a splat, and fill its place.

    What is marked goes, up to the surface that is seen there, and is a hole whatever stands behind
    it. Photographs of the splat help. `gscompleter live` marks and repairs in the browser.
    `gscompleter strip` gives the splat back as it was.

    Example: gscompleter repair splat.ply --target camera.json --mask wrong.png --out repaired
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """The splat; or the folder of its photographs, in any layout that `complete` reads, if
    `--scene` names the splat."""
    target: tuple[str, ...] = ()
    """Target cameras: file names or numbers of photographs, or a file of cameras (transforms.json,
    cameras.json, nerfstudio's camera_path.json, COLMAP's images.txt, SuperSplat poses).
    One for each mask; with `--select`, those that the place is filled at."""
    mask: tuple[Path, ...] = ()
    """Masks of what goes, white there. An image for each target camera, in their order: what it
    marks is wrong, goes, is a hole whatever stands behind it, and is filled; `strip` puts it
    back."""
    select: Path | None = None
    """Remove the Gaussians of this file, a selection that another program saved. It stands in place
    of masks; their place is a hole where the target cameras see it, whatever stands behind."""
    strokes: Path | None = None
    """The strokes.json that `live` saved. It stands in place of cameras and masks: its steps are
    done again, at its resolution and with its photographs unless others are named."""
    out: Path
    """Write results here. A folder, for completed.ply, the report (report.html), images and
    summary.json."""


def decide_repair(options: RepairOptions) -> RepairRequest:
    """Decide what is repaired at the target cameras: what masks mark there, or a selection."""
    has_masks = options.select is None
    check_splat_named(options, "marked")
    check_context(options.context)
    check_generator(options.synthesis.generator)
    completion = decide_filling(
        options,
        TargetRequest(options.target),
        decide_results(options),
        context=options.context,
        synthesis=options.synthesis,
        has_marks=has_masks,
        adapt=CompleterConfig.for_marks,
    )
    if options.select is not None:
        selection = Selection(file=options.select, drop_nonfinite=options.drop_nonfinite)
        return RepairRequest(completion, selection=selection)
    reading = MaskReading(options.invert_masks, options.large_masks)
    return RepairRequest(completion, options.mask, reading)


def run_repair(options: RepairOptions) -> int:
    """Repair the splat, and print a summary; exit codes as of `complete`."""
    check_marks_named(options)
    # Imported here, so that help pages do not wait for torch.
    if options.strokes is not None:
        with import_without_collection():
            from gscompleter.apps.commands.sessions import decide_replay
            from gscompleter.apps.live.replay import replay_session
        return replay_session(decide_replay(options, options.strokes))
    with import_without_collection():
        from gscompleter.apps.completing.complete import run_request
    return run_request(decide_repair(options))


def check_marks_named(options: RepairOptions) -> None:
    """Refuse options that do not say what is wrong, or say it twice."""
    if options.strokes is not None:
        if options.target or options.mask or options.select:
            raise InputError(
                "Strokes have cameras and marks of their own; leave --target, --mask and --select "
                "out.",
                "strokes",
            )
    elif options.mask and options.select:
        raise InputError(
            "Masks and a selection both say what goes; give one of them, or one after the other in "
            "two commands.",
            "select",
        )
    elif not options.target and not options.mask and not options.select:
        raise InputError(
            "Nothing is named that is wrong; give --target with --mask or --select, or the "
            "--strokes of a session of `live`."
        )
    elif not options.target and options.select:
        raise InputError(
            "The place of a selection is filled as a camera sees it; name the camera, or let "
            "`gscompleter remove --select` find cameras.",
            "target",
        )
    elif not options.target:
        raise InputError("A mask is painted at a camera; name it.", "target")
    elif not options.mask and not options.select:
        raise InputError(
            "A camera alone marks nothing; name the mask painted there, or the selected Gaussians "
            "with --select.",
            "mask",
        )
