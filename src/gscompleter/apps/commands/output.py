"""Input of a run for `summary.json`, and messages of interrupted runs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gscompleter.apps.commands.options import SceneOptions, parse_resolution
from gscompleter.apps.inputs.opening import Opened, Task, select_closest
from gscompleter.apps.report.completion import HeldOut
from gscompleter.config import CompleterConfig
from gscompleter.config.cleaning import CleaningConfig
from gscompleter.data.sfm.poses import POSES
from gscompleter.errors import InputError
from gscompleter.io.files import SUMMARY_FILE
from gscompleter.types import Camera, View

MAX_HELD_OUT = 8
"""Most unused photographs to score."""


def describe_opened(options: SceneOptions, opened: Opened, task: Task) -> dict[str, Any]:
    """Describe the opened scene, its frame and its depth range."""
    camera = task.views[0].camera
    return {
        "scene": {
            "format": opened.format,
            "photographs": opened.num_photographs,
            "used": len(task.views),
            "splat": None if options.scene is None else str(options.scene),
        },
        "frame": {
            "method": task.method,
            "transform": task.frame.tolist(),
            "origin": task.origin.tolist(),
        },
        "depth_range": {"near": camera.near, "far": camera.far, "from": asdict(task.depths)},
    }


def describe_settings(
    options: SceneOptions,
    config: CompleterConfig | CleaningConfig,
    targets: Mapping[str, Any],
    models: Mapping[str, Any],
) -> dict[str, Any]:
    """Describe all settings that determine the result."""
    return {
        "folder": str(options.folder),
        "format": options.format,
        "context": None if options.context is None else list(options.context),
        **targets,
        "scene": None if options.scene is None else str(options.scene),
        **models,
        "resolution": options.resolution,
        "near": options.near,
        "far": options.far,
        "config": asdict(config),
    }


def read_held_out(
    options: SceneOptions, opened: Opened, task: Task, cameras: Mapping[int, Camera]
) -> list[HeldOut]:
    """Read up to `MAX_HELD_OUT` unused photographs, nearest to the targets or the context.

    `cameras` are those of all usable photographs by frame, in the frame of the result.
    """
    used = {view.frame for view in task.views} | {target.frame for target in task.targets}
    others = {frame: camera for frame, camera in cameras.items() if frame not in used}
    wanted = [target.camera for target in task.targets] or [view.camera for view in task.views]
    checks = {view.frame for view in task.check_views or ()}
    held_out, device = list[HeldOut](), task.views[0].image.device
    for frame in select_closest([camera.to(device) for camera in wanted], others, MAX_HELD_OUT):
        with suppress(InputError):
            (view,) = opened.photographs.views([frame], parse_resolution(options.resolution))
            view = View(view.image, others[frame], frame, ignore_mask=view.ignore_mask).to(device)
            held_out.append(HeldOut(view, frame in checks))
    return held_out


def is_replaceable(options: SceneOptions) -> bool:
    """Return True if the content of the output folder may be replaced."""
    return options.overwrite or has_poses_only(options.out)


def has_poses_only(out: Path) -> bool:
    """Return True if a folder contains only the cameras of an earlier run."""
    return os.path.isdir(out) and os.listdir(out) == [POSES]


@contextmanager
def report_interrupts(out: Path) -> Iterator[None]:
    """Let an interrupt name the results that were written."""
    before = get_result_times(out)
    try:
        yield
    except KeyboardInterrupt as stop:
        there = get_result_times(out)
        if there[0] != before[0]:
            raise KeyboardInterrupt(f"the result is written: {out}") from stop
        if there[1] != before[1]:
            raise KeyboardInterrupt(
                f"nothing was written but the cameras that were found: {out / POSES}"
            ) from stop
        raise


def get_result_times(out: Path) -> list[int | None]:
    """Return the modification times of the result and of found cameras, or None without."""
    summaries = [out / SUMMARY_FILE, out / POSES / SUMMARY_FILE]
    return [s.stat().st_mtime_ns if s.is_file() else None for s in summaries]
