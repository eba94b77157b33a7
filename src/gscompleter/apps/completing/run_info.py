"""What a run was given: values for `summary.json`, and photographs that test its result."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.apps.inputs.describing import describe_missing_photographs
from gscompleter.apps.inputs.selection import select_closest
from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.apps.requests.scene import (
    AloneRequest,
    PhotographsRequest,
)
from gscompleter.apps.requests.splat import SplatRequest
from gscompleter.config import CleaningConfig, CompleterConfig
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.sfm import NUM_VIDEO_FRAMES
from gscompleter.evaluation.verdict.held_out import HeldOut
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, View

MAX_HELD_OUT = 8
"""Most photographs that test a result, if none were kept back for it."""


def describe_run_values(
    source: PhotographsRequest | AloneRequest,
    given: SplatRequest | None,
    opened: Opened,
    task: CompletionTask,
    config: CompleterConfig | CleaningConfig,
    settings: Mapping[str, Any] = MappingProxyType({}),
    inverts_masks: bool = False,
) -> dict[str, Any]:
    """Describe the input and all settings that determine the result, as values of JSON.

    They are the entries of `summary.json` that docs/contracts.md lists from `settings` to
    `depth_range`.

    Args:
        source: What the command was given: photographs, or a splat alone.
        given: The input splat, if there is one, and how it was read.
        opened: The scene after it was opened.
        task: What was read of it. Its views share one depth range.
        config: Settings of the method.
        settings: Those of the command alone, such as its models.
        inverts_masks: True if masks were read with black and white exchanged: those that mark what
            a command takes out, or, without any, those of photographs.
    """
    camera = task.views[0].camera
    # The request before it was opened: opening may change the resolution, and nothing else here.
    reading = source.scene
    resolution = opened.request.resolution
    splat = None if given is None else str(given.path)
    of_source: dict[str, Any]
    if isinstance(source, PhotographsRequest):
        of_source = {"folder": str(reading.folder), "frames": source.poses.num_frames}
    else:
        # The folder of its reading is the splat itself, and there is no video.
        of_source = {
            "folder": None,
            "frames": NUM_VIDEO_FRAMES,
            "cameras": None if source.cameras is None else str(source.cameras),
            "up": source.up,
        }
    return {
        "settings": {
            **of_source,
            "format": reading.format,
            "context": None if source.context is None else list(source.context),
            "scene": splat,
            "drop_nonfinite": given is not None and given.drop_nonfinite,
            "forget_edits": given is not None and given.forget_edits,
            **settings,
            "resolution": "full" if resolution is None else resolution,
            "near": reading.near,
            "far": reading.far,
            "no_given_depth": not reading.uses_given_depth,
            "no_refine_poses": not reading.refines_poses,
            "masks": reading.uses_masks,
            "ignore": None if reading.masks.folder is None else str(reading.masks.folder),
            "invert_masks": inverts_masks,
            "large_masks": reading.masks.may_be_large,
            "config": asdict(config),
        },
        "device": task.device.type,
        "scene": {
            "format": opened.format,
            "photographs": opened.num_photographs,
            "used": len(task.views),
            "fitted": 0 if task.scene is not None else len(task.check_views or ()),
            "splat": splat,
            "renders_from": opened.renders_from,
            "refined_poses": opened.refinement and asdict(opened.refinement),
            "notes": [
                *opened.photographs.notes,
                *describe_missing_photographs(opened.photographs),
                *(f"Not used: {phrase}." for phrase in opened.photographs.unused),
            ],
        },
        "frame": {
            "method": task.method,
            "transform": compute_frame_of_file(task).tolist(),
            "origin": task.origin.tolist(),
        },
        "depth_range": {"near": camera.near, "far": camera.far, "from": dict(task.depths)},
    }


def compute_frame_of_file(task: CompletionTask) -> Float[np.ndarray, "4 4"]:
    """Compute the similarity from the coordinates of the photographs to those of written files."""
    # The result is relative to the origin of the splat, which is added when it is written.
    origin = None if task.scene is None else task.scene.origin
    if origin is None:
        return task.frame
    return compute_frame_from_photographs(-np.array(origin)) @ task.frame


def read_held_out(
    opened: Opened, task: CompletionTask, cameras: Mapping[int, Camera]
) -> list[HeldOut]:
    """Read the photographs that were kept back, or up to `MAX_HELD_OUT` unused ones.

    The unused ones are those nearest to the targets or the context. `cameras` are those of all
    usable photographs by frame, in the frame of the result.
    """
    # Renders of the splat itself test nothing.
    if opened.renders_from is not None:
        return []
    used = task.used_frames
    unused = {frame: camera for frame, camera in cameras.items() if frame not in used}
    # Check views of a splat guard its completion, so they test less than photographs that nothing
    # has read.
    checks = {view.frame for view in task.check_views or ()}
    frames = opened.held_out or select_closest(task.goals, unused, MAX_HELD_OUT)
    read: dict[int, View] = {}
    for frame in frames:
        # A photograph that cannot be read tests nothing; it is no input of this run.
        with suppress(InputError):
            (read[frame],) = opened.photographs.views([frame], opened.request.resolution)
    held_out = []
    # A loop of its own, since an InputError from here on is a fault of ours and not suppressed.
    for frame, view in read.items():
        # All that are kept back have a usable camera, and are not used (`update.hold_out`).
        # The camera of the view is in the frame of the photographs. That in `cameras` is in the
        # frame of the result, and on the device of the task, to which the image follows.
        moved = view.to(task.device)
        placed = View(moved.image, unused[frame], frame, ignore_mask=moved.ignore_mask)
        if task.taken_out is not None:
            placed = task.taken_out.hide(placed)
        held_out.append(HeldOut(placed, frame in checks))
    return held_out
