"""The command `poses`: find the cameras of photographs, or refine those that they have."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.commands.shared_options import (
    ComputeOptions,
    MaskOptions,
    NumFrames,
    WritingOptions,
)
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.sfm import NUM_VIDEO_FRAMES
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class PosesOptions(ComputeOptions, WritingOptions, MaskOptions):
    """Find the cameras of photographs with COLMAP, and write a COLMAP folder.

    A second run with the same photographs or video keeps the result. Photographs that have cameras
    get them refined, as far as features that were kept back agree, in a transforms.json.

    Example: gscompleter poses photographs --out cameras
    """

    photographs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of overlapping photographs or 360° panoramas (2:1) of one scene, or a video. They are
    not changed. Of a scene with cameras, its folder or camera file: its images alone have none."""
    frames: NumFrames = NUM_VIDEO_FRAMES
    """Most frames of a video to take as photographs, sharp ones at even steps of the camera."""
    out: Path
    """Write results here. A folder, for upright copies in images, and cameras and points in
    sparse/0; or for transforms.json, which names the photographs where they lie."""


def run_poses(options: PosesOptions) -> None:
    """Find and write the cameras, and print their number and error."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.inputs.opening import refuse_frames_of_no_video
        from gscompleter.data.given_poses import has_cameras
        from gscompleter.data.sfm.poses import find_poses
        from gscompleter.system.console import make_console
        from gscompleter.system.progress import show_progress

    refuse_frames_of_no_video(options.photographs, options.frames)
    if has_cameras(options.photographs):
        refine_cameras(options)
        return
    reading = MaskReading(options.invert_masks, options.large_masks)
    with show_progress(make_console(stderr=True, quiet=options.quiet)):
        poses = find_poses(
            options.photographs, options.out, options.overwrite, options.frames, reading
        )
    origin = ", found by an earlier run" if poses.reused else ""
    sentence = (
        f"{poses.num_registered} of {poses.photographs} cameras and {poses.points:,} points, "
        f"mean error {poses.error:.2f} px{origin}: {options.out}"
    )
    content = {
        "out": str(options.out),
        "cameras": poses.num_registered,
        "photographs": poses.photographs,
        "points": poses.points,
        "error_px": poses.error,
        "reused": poses.reused,
        "notes": list(poses.notes),
    }
    print_answer(options.answer, content, [*poses.notes, sentence])


def refine_cameras(options: PosesOptions) -> None:
    """Refine and write the cameras that photographs have, and print by how much they gained."""
    from gscompleter.data.given_poses import refine_given_poses
    from gscompleter.system.console import make_console
    from gscompleter.system.progress import show_progress

    reading = MaskReading(options.invert_masks, options.large_masks)
    with show_progress(make_console(stderr=True, quiet=options.quiet)):
        refined = refine_given_poses(options.photographs, options.out, options.overwrite, reading)
    notes = [refined.kept] if refined.kept else []
    content = {
        "out": str(options.out),
        "cameras": len(refined.photographs.posed),
        "photographs": len(refined.photographs),
        "is_refined": refined.refinement.is_accepted,
        "given_error_px": refined.refinement.given_error,
        "refined_error_px": refined.refinement.refined_error,
        "notes": notes,
    }
    print_answer(options.answer, content, [*notes, refined.describe(options.out)])
