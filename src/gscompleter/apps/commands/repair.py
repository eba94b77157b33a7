"""The command `repair`: take what is wrong out of a splat, and fill its place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.shared_options import CompletingOptions
from gscompleter.config import CompleterConfig
from gscompleter.system.errors import InputError
from gscompleter.system.process import import_without_collection

REPAIR_CONFIG = CompleterConfig.splat().for_marks()


@dataclass(frozen=True, kw_only=True)
class RepairOptions(CompletingOptions):
    """Take what masks mark out of a splat, and fill its place.

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
    One for each mask."""
    mask: tuple[Path, ...] = ()
    """Masks of what goes, white there. An image for each target camera, in their order: what it
    marks is wrong, goes, is a hole whatever stands behind it, and is filled; `strip` puts it
    back."""
    strokes: Path | None = None
    """The strokes.json that `live` saved. It stands in place of cameras and masks: its steps are
    done again, at its resolution and with its photographs unless others are named."""
    out: Path
    """Write results here. A folder, for completed.ply, the report (report.html), images and
    summary.json."""
    config: Annotated[CompleterConfig, tyro.conf.FlagConversionOff] = REPAIR_CONFIG
    """Settings of the method, which change those of `--config NAME`."""

    @property
    def marks(self) -> tuple[Path, ...]:
        """Masks of what is wrong."""
        return self.mask

    def make_completion(self) -> CompleteOptions:
        """Make the options of the completion, at the cameras of the masks, that a repair is."""
        shared = {**vars(self)}
        del shared["strokes"]
        return CompleteOptions(**shared)


def run_repair(options: RepairOptions) -> int:
    """Repair the splat, and print a summary; exit codes as of `complete`."""
    # Imported here, so that help pages do not wait for torch.
    check_marks_named(options)
    if options.strokes is not None:
        with import_without_collection():
            from gscompleter.apps.live.replay import replay_strokes
        return replay_strokes(options, options.strokes)
    with import_without_collection():
        from gscompleter.apps.completing.complete import complete_scene
    return complete_scene(options.make_completion())


def check_marks_named(options: RepairOptions) -> None:
    """Refuse options that do not say what is wrong, or say it twice."""
    if options.strokes is not None:
        if options.target or options.mask:
            raise InputError(
                "Strokes have cameras and masks of their own; leave --target and --mask out.",
                "strokes",
            )
    elif not options.target and not options.mask:
        raise InputError(
            "Nothing is named that is wrong; give --target and --mask, or the --strokes of a "
            "session of `live`."
        )
    elif not options.target:
        raise InputError("A mask is painted at a camera; name it.", "target")
    elif not options.mask:
        raise InputError("A camera alone marks nothing; name the mask painted there.", "mask")
