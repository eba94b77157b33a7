"""The command `complete`: fill what the photographs of a scene do not show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from gscompleter.apps.commands.shared_options import (
    DEFAULT_NUM_TARGETS,
    CompletingOptions,
    list_inputs,
)
from gscompleter.apps.inputs.scene_request import PosesRequest
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.overlap import refuse_overlap
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class CompleteOptions(CompletingOptions):
    """Fill the parts of a scene that its photographs do not show, and write the result.

    Example: gscompleter complete photographs --out result
    """

    target: tuple[str, ...] = ()
    """Target cameras: file names or numbers of photographs, or a file of cameras (transforms.json,
    cameras.json, nerfstudio's camera_path.json, COLMAP's images.txt, SuperSplat poses).
    If not given, cameras that see holes are searched for and written to targets.json."""
    mask: tuple[Path, ...] = ()
    """Masks of what goes, white there. An image for each target camera, in their order: what it
    marks is wrong, goes, is a hole whatever stands behind it, and is filled; `strip` puts it
    back."""
    auto: Annotated[int, Interval(ge=1, le=254)] | None = None
    """Most cameras to search for if no target is given; 4 if no number follows."""
    dry_run: bool = False
    """Only show what would be done. The plan is printed, its cameras are written to targets.json,
    which `--target` reads, and what they see to images."""
    export_holes: Path | None = None
    """Only write to this folder what another program needs to paint the holes of the targets. The
    same command with `--images` completes the scene."""
    path: bool = False
    """With `--export-holes`, also write a video along the targets and its mask."""
    images: Path | None = None
    """Folder of painted images or of a repaired video, named as `--export-holes` did, in place of a
    generator. Without `--target`, its holes.json has the targets."""
    painter: str | None = None
    """Name of their painter, for the report."""
    out: Path
    """Write results here. A folder, for completed.ply, the report (report.html), images and
    summary.json."""
    save_as: Literal[".ply", ".spz", ".sog"] | None = None
    """Keep results small: write the completed scene in this format, with its labels, and
    context.ply only if it differs from the input splat. `.spz` and `.sog` round, so that `strip`
    does not give back the same bytes."""
    video: bool = False
    """Also write video.mp4: a flight through the holes, before beside after."""

    def make_poses_request(self) -> PosesRequest:
        """Make the request for the cameras, with the targets among the named photographs."""
        request = super().make_poses_request()
        return replace(request, named=(*request.named, *self.target))

    def check_overlap(self) -> None:
        """Refuse an output that is, holds or lies in an input or the other output."""
        super().check_overlap()
        folder = self.export_holes
        if folder is None:
            return
        refuse_overlap(folder, list_inputs(self), "export-holes", may_continue=False)
        try:
            refuse_overlap(folder, [self.out], may_continue=False)
        except InputError as error:
            raise InputError(
                f"{quote_value(folder)} and OUT have to lie apart from each other, since what is "
                "painted is an input of the completion; name another folder.",
                "export-holes",
            ) from error

    @property
    def results(self) -> Path:
        """Folder that is written: that of the export, or else OUT."""
        return self.out if self.export_holes is None else self.export_holes

    @property
    def marks(self) -> tuple[Path, ...]:
        """Masks of what is wrong at the targets."""
        return self.mask

    @property
    def from_photographs_only(self) -> bool:
        """True if nothing is invented and there are no targets, as `update` has it."""
        return False

    @property
    def max_targets(self) -> int:
        """Number of targets to search for."""
        return DEFAULT_NUM_TARGETS if self.auto is None else self.auto


def run_complete(options: CompleteOptions) -> int:
    """Complete the scene, and print a summary. Exit code 1 if the scene did not reconstruct."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.completing.complete import complete_scene
    return complete_scene(options)
