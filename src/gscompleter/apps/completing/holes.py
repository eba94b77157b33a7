"""Export of the holes of targets, for whoever paints them.

`holes.json` lists the targets; `apps/inputs/paintings.py` reads it back, with what was painted.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from gscompleter import __version__
from gscompleter.apps.completing.path_video import PATH_MASK, PATH_VIDEO, plan_path, write_path
from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.inputs.holes_file import HOLES_FILE, HoleRow, read_holes
from gscompleter.apps.inputs.paintings import PAINTING_ENDINGS, VIDEO_ENDINGS, list_by_stem
from gscompleter.apps.inputs.task import Target
from gscompleter.apps.report.hole_pictures import HolePictures, draw_hole
from gscompleter.config.settings import COVERED
from gscompleter.data.scene import describe_camera
from gscompleter.numerics.geometry import pad_camera
from gscompleter.numerics.visible_field import compute_visible_field
from gscompleter.splats.alignment.similarity import get_scale, transform_camera_exactly
from gscompleter.stages.refusals import explain_skip
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.state import Completion
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.depth_file import write_depth
from gscompleter.system.files.image import write_image
from gscompleter.system.files.reading import hash_file
from gscompleter.system.files.result_format import RESULT_MARK
from gscompleter.system.progress import track
from gscompleter.types import Camera

VISIBLE_FIELD = "visible_field.npz"
"""File of a `VisibleField`, for programs that complete geometry."""
EXPORTED = ("target*.png", PATH_VIDEO, PATH_MASK, VISIBLE_FIELD, HOLES_FILE)
"""Globs of the files that an export may write."""
DEPTH_STEPS = 65535
"""Largest value of a 16-bit depth map."""


@dataclass(frozen=True)
class ExportedHole:
    """A target whose hole is exported."""

    number: int
    """Number of the target, from 1, by which its files are named."""
    target: Target
    camera: Camera
    """In the frame of the photographs, in float64."""
    pictures: HolePictures
    depth: Float[Tensor, "h w"]
    """z-depth in the unit of `camera`, 0 where the scene is empty."""
    hole_fraction: float
    """Share of the image that is a hole; the mask to paint is somewhat larger."""

    @property
    def name(self) -> str:
        """Beginning of the names of its files."""
        return f"target{self.number}"


def refuse_painted(folder: Path) -> None:
    """Refuse to export to a folder where images or the video of an earlier export were painted.

    A painted image may have another ending than the exported one. It would stay, and be taken for
    that of the new target of its number.
    """
    exported: list[tuple[str, str, Sequence[str]]] = []
    # A damaged file says nothing of its images, and is replaced.
    with suppress(InputError):
        holes = read_holes(folder)
        exported += [(row.image_path, row.sha256, PAINTING_ENDINGS) for row in holes.frames]
        if holes.path is not None:
            exported.append((holes.path.video_path, holes.path.sha256, VIDEO_ENDINGS))
    for name, sha256, endings in exported:
        for path in list_by_stem(folder, name, endings, sha256):
            raise InputError(
                f"{quote_value(path)} was painted; name another folder for the export.",
                "export-holes",
            )


def write_holes(folder: Path, ready: Prepared, begun: Completion, has_path: bool) -> list[str]:
    """Write the files of an export; return a line about each target that is left out.

    All targets are seen in the scene as it is, so that a hole which several of them see is exported
    with each. `has_path` is True for a video along the targets. `begun` is the scene before
    anything is filled.

    Raises:
        InputError: No target has a hole.
    """
    exported = []
    skipped = []
    for number, target in enumerate(track(ready.task.targets, "target"), start=1):
        view = observe_hole(ready, begun, target)
        if reason := explain_skip(view):
            skipped.append(f"Target {number} is left out: {reason}")
        else:
            exported.append(make_export(number, target, view, ready.task.frame))
    if not exported:
        # Without targets the planner was asked for some, and found none.
        reason = skipped[0].partition(": ")[2] if skipped else "No camera has much to gain."
        raise InputError(f"There is nothing to paint: {reason}", "target")

    # One unit for all depth maps, as in a transforms.json: the farthest depth is `DEPTH_STEPS`.
    farthest = max(hole.depth.max().item() for hole in exported)
    unit = (farthest or 1.0) / DEPTH_STEPS
    rows = [write_hole(folder, hole, unit, ready) for hole in exported]
    path = None
    if has_path:
        targets = [begun.with_depth_range(hole.target.camera) for hole in exported]
        context = [view.camera for view in begun.views]
        planned = plan_path(context, targets, list(ready.cameras.values()))
        path = write_path(folder, ready, begun, planned)
        for row, frame in zip(rows, planned.target_frames, strict=True):
            row["path_frame"] = frame
    # Renders at cameras that were found have no numbers that a later command could be given; they
    # are found again.
    frames = ready.task.context_frames if ready.opened.has_numbered_frames else ()
    content = {
        **RESULT_MARK,
        "version": __version__,
        "camera_model": "PINHOLE",
        "depth_unit_scale_factor": unit,
        "context": list(frames),
        "frames": rows,
        "path": path,
        "visible_field_path": write_visible_field(folder, ready, begun, exported),
    }
    (folder / HOLES_FILE).write_bytes(json.dumps(content, indent=1).encode() + b"\n")
    return skipped


def write_visible_field(
    folder: Path, ready: Prepared, begun: Completion, exported: Sequence[ExportedHole]
) -> str | None:
    """Write the distance field of what context and exported targets see of the scene.

    It is in the frame and unit of the photographs. Return the name of its file, or None if they see
    nothing.
    """
    to_photographs = np.linalg.inv(ready.task.frame)
    context = [view.camera for view in begun.views]
    renders = [view.render for view in ready.completer.scenes.freeze_at(begun.parts, context)]
    cameras = [transform_camera_exactly(camera.to("cpu"), to_photographs) for camera in context]
    depths = [
        render.depth.where(render.alpha >= COVERED, 0.0).cpu() * get_scale(to_photographs)
        for render in renders
    ]
    cameras += [hole.camera.to("cpu") for hole in exported]
    depths += [hole.depth.cpu() for hole in exported]
    field = compute_visible_field(cameras, depths)
    if field is None:
        return None
    np.savez_compressed(folder / VISIBLE_FIELD, **vars(field))
    return VISIBLE_FIELD


def observe_hole(ready: Prepared, begun: Completion, target: Target) -> TargetView:
    """Render the scene at a target without padding: painters get the target's own image."""
    camera = begun.with_depth_range(target.camera.to(ready.task.device))
    return render_target(begun, pad_camera(camera, 0.0), ready.completer.scenes)


def make_export(
    number: int, target: Target, view: TargetView, frame: Float[np.ndarray, "4 4"]
) -> ExportedHole:
    """Collect what a target shows; `frame` leads from the photographs to the result."""
    to_photographs = np.linalg.inv(frame)
    pictures = draw_hole(view)
    return ExportedHole(
        number,
        target,
        camera=transform_camera_exactly(view.camera.target, to_photographs),
        pictures=pictures,
        depth=pictures.depth * get_scale(to_photographs),
        hole_fraction=view.holes.float().mean().item(),
    )


def write_hole(folder: Path, hole: ExportedHole, unit: float, ready: Prepared) -> dict[str, Any]:
    """Write the pictures of a target, and return its entry in `holes.json`.

    `unit` is the depth of one step of its depth map, in the unit of the photographs.
    """
    name = hole.name
    shown = hole.pictures
    pictures = {
        f"{name}.png": shown.image,
        f"{name}_mask.png": shown.mask,
        f"{name}_warped.png": shown.warped,
        f"{name}_reference.png": shown.reference.image,
    }
    for file, picture in pictures.items():
        write_image(folder / file, picture)
    write_depth(folder / f"{name}_depth.png", hole.depth, unit)

    target = hole.target
    opened = ready.opened
    is_numbered = opened.has_numbered_frames
    row = HoleRow(
        image_path=f"{name}.png",
        sha256=hash_file(folder / f"{name}.png"),
        hole_mask_path=f"{name}_mask.png",
        w=hole.camera.width,
        h=hole.camera.height,
        hole_fraction=hole.hole_fraction,
        frame=target.frame,
        # Renders at cameras that were found are others in the next command.
        derived_from=target.derived_from if is_numbered else None,
        offset=target.offset if is_numbered else None,
        title=opened.name_target(target),
    )
    return {
        **asdict(row),
        "depth_file_path": f"{name}_depth.png",
        "warped_path": f"{name}_warped.png",
        "reference_path": f"{name}_reference.png",
        "reference_frame": shown.reference.frame,
        "reference_file": opened.files.get(shown.reference.frame),
        **describe_camera(hole.camera),
    }
