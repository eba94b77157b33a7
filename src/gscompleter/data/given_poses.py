"""Refinement of photographs that have cameras, into a file that trainers read.

Poses of phones, SLAM and drives gain by it for every program. The result is nerfstudio's
`transforms.json`, whose paths lead to the photographs where they lie: nothing is copied.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from gscompleter.data.formats import find_format, open_photographs
from gscompleter.data.limits import require
from gscompleter.data.mask_checks import read_masks_as_asked, refuse_nothing_to_invert
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.poses import POSES_COMMAND
from gscompleter.data.sfm.refining import MIN_REFINED, PoseRefinement, refine_poses
from gscompleter.data.transforms import TRANSFORMS_FILE, describe_transforms, write_transforms
from gscompleter.numerics.two_views import ERROR_SIDE
from gscompleter.system.errors import quote_value
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.result_names import SUMMARY_FILE


@dataclass(frozen=True)
class RefinedCameras:
    """Photographs that had cameras, after a refinement."""

    photographs: Photographs
    """With the refined poses; all as given unless kept-back matches agree clearly better."""
    refinement: PoseRefinement
    kept: str
    """Sentence on what else lies in the output folder; empty if there is nothing."""

    def describe(self, out: Path) -> str:
        """Describe the result in a sentence for the user; `out` is the output folder."""
        errors = (
            f"given poses miss matches by {self.refinement.given_error:.2f} px (of {ERROR_SIDE}), "
            f"refined ones by {self.refinement.refined_error:.2f}"
        )
        count = len(self.photographs.present)
        # Others keep their cameras, in the same file: those that COLMAP could not refine, that a
        # mask hides, or that are too many (`choose_known`).
        number = self.refinement.photographs
        refined = f"{number}" if number == count else f"{number} of {count}"
        done = f"{count} photographs stay as they are"
        if self.refinement.is_accepted:
            done = f"{refined} photographs are refined"
        return f"The cameras of {done}: {errors}: {out}"


def has_cameras(path: Path) -> bool:
    """Return True if a path holds photographs with cameras, by names and first bytes of files."""
    return find_format(path) not in (None, "photograph")


def refine_given_poses(
    path: Path, out: Path, overwrite: bool = False, reading: MaskReading = MaskReading()
) -> RefinedCameras:
    """Refine the cameras of photographs that have some, and write them for other programs.

    They are written as given unless matches agree clearly better with the refined ones
    (`PoseRefinement.is_accepted`). Raises InputError if they cannot be refined, or if the file
    cannot describe them (`describe_transforms`).
    """
    given = open_photographs(path)
    refuse_nothing_to_invert(given.list_masks(), reading)
    given = read_masks_as_asked(given, reading)
    # Refuses what cannot be written before minutes of COLMAP.
    describe_transforms(given, out)
    written = (TRANSFORMS_FILE, SUMMARY_FILE)
    with (
        reserve_output(out, overwrite, POSES_COMMAND, written) as output,
        output.write() as folder,
    ):
        photographs, refinement = refine_poses(given)
        require(
            refinement is not None,
            f"The cameras of {quote_value(path)} cannot be refined: COLMAP used fewer than "
            f"{MIN_REFINED} photographs, or most share their place with another; use them as "
            "they are.",
        )
        assert refinement is not None
        write_transforms(folder / TRANSFORMS_FILE, photographs, out)
        content = {"poses": asdict(refinement), "scene": str(path)}
        (folder / SUMMARY_FILE).write_bytes(json.dumps(content, indent=1).encode())
    return RefinedCameras(photographs, refinement, " ".join(output.describe_others()))
