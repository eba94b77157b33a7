"""A video along the targets of an export, with its mask, for models that repair video.

The camera starts at the photograph nearest to the first target and passes all targets. At the
frames at which it stands at a target, a repaired video shows what was painted for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.inputs.holes_file import PathRow
from gscompleter.apps.report.film import (
    FRAMES_PER_SECOND,
    MIN_LEG_SECONDS,
    ONE_WAY_SECONDS,
    plan_camera_path,
)
from gscompleter.apps.report.record import MAX_PHOTOGRAPHS, thin_evenly
from gscompleter.data.scene import describe_camera
from gscompleter.generators.warp import BORDER_WIDTH
from gscompleter.numerics.geometry import measure_baseline, pad_camera, resize_camera
from gscompleter.numerics.image_ops import dilate
from gscompleter.splats.alignment.similarity import transform_camera_exactly
from gscompleter.stages.target_view import render_target
from gscompleter.state import Completion
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.system.files.reading import hash_file
from gscompleter.system.files.video import write_video
from gscompleter.system.progress import track
from gscompleter.types import Camera

PATH_VIDEO = "path.mp4"
"""Renders of the scene along the path, which a video model is to repair."""
PATH_MASK = "path_mask.mp4"
"""White where to repair, frame by frame as in `PATH_VIDEO`."""
FRAME_STEP = 4
"""Video models take 4 n + 1 frames, since their encoders join four frames."""


@dataclass(frozen=True)
class CameraPath:
    """Cameras of a video that passes targets."""

    cameras: Sequence[Camera]
    target_frames: Sequence[int | None]
    """Frame at which the camera stands at each target; None for a target with another lens."""


def plan_path(
    context: Sequence[Camera], targets: Sequence[Camera], photographs: Sequence[Camera]
) -> CameraPath:
    """Plan a smooth path from the nearest camera of the context through all targets.

    It follows `photographs`. All cameras have the lens of the first target, at an even size, which
    video encoders need.
    """
    first = targets[0]
    # Resizing scales the intrinsics, too, so that an odd side becomes even without a crop.
    lens = resize_camera(first, first.width + first.width % 2, first.height + first.height % 2)
    nearest = min(context, key=lambda camera: measure_baseline(camera, first))
    stops = [replace(lens, c2w=camera.c2w.to(lens.c2w)) for camera in (nearest, *targets)]
    # One leg leads to each target, in a multiple of `FRAME_STEP` frames; the last camera is added.
    seconds = max(ONE_WAY_SECONDS / len(targets), MIN_LEG_SECONDS)
    leg_frames = FRAME_STEP * math.ceil(FRAMES_PER_SECOND * seconds / FRAME_STEP)
    cameras = plan_camera_path(stops, thin_evenly(photographs, MAX_PHOTOGRAPHS), leg_frames)
    target_frames = [
        leg_frames * number if has_same_lens(target, first) else None
        for number, target in enumerate(targets, start=1)
    ]
    return CameraPath(cameras, target_frames)


def has_same_lens(a: Camera, b: Camera) -> bool:
    """Check whether two cameras have the same image size and intrinsics."""
    return (a.width, a.height) == (b.width, b.height) and torch.allclose(a.K, b.K, rtol=1e-5)


def write_path(
    folder: Path, ready: Prepared, begun: Completion, path: CameraPath
) -> dict[str, Any]:
    """Write the video and its mask, and return their entry in `holes.json`."""
    # ffmpeg writes one video at a time: frames are written while they are rendered, and the masks,
    # which come with them, are kept until then.
    masks: list[UInt8[np.ndarray, "h w"]] = []
    frames = render_path(ready, begun, path.cameras, masks)
    write_video(folder / PATH_VIDEO, frames, FRAMES_PER_SECOND)
    # Three equal channels only here, since all masks lie in memory.
    grey = (np.repeat(mask[..., None], 3, axis=-1) for mask in masks)
    write_video(folder / PATH_MASK, grey, FRAMES_PER_SECOND)
    row = PathRow(
        video_path=PATH_VIDEO,
        sha256=hash_file(folder / PATH_VIDEO),
        num_frames=len(path.cameras),
    )
    # The file has cameras in the frame of the photographs, as every file of cameras has.
    to_photographs = np.linalg.inv(ready.task.frame)
    return {
        **asdict(row),
        "hole_mask_path": PATH_MASK,
        "frames_per_second": FRAMES_PER_SECOND,
        "cameras": [
            describe_camera(transform_camera_exactly(camera, to_photographs))
            for camera in path.cameras
        ],
    }


def render_path(
    ready: Prepared,
    begun: Completion,
    cameras: Sequence[Camera],
    masks: list[UInt8[np.ndarray, "h w"]],
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Render the scene along a path, and append the mask of each frame to `masks`.

    Holes are found as at a target, and widened as in its mask (`draw_hole`).
    """
    for camera in track(cameras, "video"):
        placed = begun.with_depth_range(camera.to(ready.task.device))
        view = render_target(begun, pad_camera(placed, 0.0), ready.completer.scenes)
        masks.append(convert_to_pixels(dilate(view.holes, BORDER_WIDTH)))
        yield convert_to_pixels(view.render.image)
