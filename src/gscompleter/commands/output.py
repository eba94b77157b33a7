"""What commands that open a scene say of it in `summary.json`, and what an interrupt leaves."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gscompleter.commands.opening import Opened, Task, closest
from gscompleter.commands.options import SceneOptions, working_size
from gscompleter.config import CompleterConfig
from gscompleter.config.cleaning import CleaningConfig
from gscompleter.data.structure_from_motion import POSES
from gscompleter.errors import InputError
from gscompleter.io.files import SUMMARY
from gscompleter.reports.completion import HeldOut
from gscompleter.types import Camera, View

MAX_HELD_OUT = 8
"""Most unused photographs that are scored: each is drawn twice, like a target."""


def opened_as(options: SceneOptions, opened: Opened, task: Task) -> dict[str, Any]:
    """What was opened, in which frame the result is, and the depth range that was worked in."""
    camera = task.views[0].camera
    return {
        "scene": {
            "format": opened.format,
            "photographs": opened.number,
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


def settings_of(
    options: SceneOptions,
    config: CompleterConfig | CleaningConfig,
    targets: Mapping[str, Any],
    models: Mapping[str, Any],
) -> dict[str, Any]:
    """Everything that decided the result: what was opened, the targets and the models where there
    are any, and `config`."""
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
    """Read the photographs that are neither of the context nor of a target: at most `MAX_HELD_OUT`,
    those closest to the targets, or to the context where there is none; none that is damaged.

    Args:
        options: What was asked for.
        opened: Where the photographs lie.
        task: What was completed.
        cameras: Those of all photographs that can be used, in the frame of the result.
    """
    taken = {view.frame for view in task.views} | {target.frame for target in task.targets}
    others = {frame: camera for frame, camera in cameras.items() if frame not in taken}
    wanted = [target.camera for target in task.targets] or [view.camera for view in task.views]
    checks = {view.frame for view in task.witnesses or ()}
    held_out, device = list[HeldOut](), task.views[0].image.device
    for frame in closest([camera.to(device) for camera in wanted], others, MAX_HELD_OUT):
        with suppress(InputError):
            (view,) = opened.photographs.views([frame], working_size(options.resolution))
            view = View(view.image, others[frame], frame, ignored=view.ignored).to(device)
            held_out.append(HeldOut(view, frame in checks))
    return held_out


def replaceable(options: SceneOptions) -> bool:
    """Whether what lies in the output folder may give way to the result."""
    return options.overwrite or holds_poses_only(options.out)


def holds_poses_only(out: Path) -> bool:
    """Whether a folder has nothing in it but the poses that an earlier run found."""
    return os.path.isdir(out) and os.listdir(out) == [POSES]


@contextmanager
def saying_what_stays(out: Path) -> Iterator[None]:
    """Let an interrupt say what it leaves in the output folder, where that is more than nothing.

    Raises:
        KeyboardInterrupt: with a sentence, or as it came.
    """
    before = written(out)
    try:
        yield
    except KeyboardInterrupt as stop:
        there = written(out)
        if there[0] != before[0]:
            raise KeyboardInterrupt(f"the result is written: {out}") from stop
        if there[1] != before[1]:
            raise KeyboardInterrupt(
                f"nothing was written but the cameras that were found: {out / POSES}"
            ) from stop
        raise


def written(out: Path) -> list[int | None]:
    """When a result, and the cameras of its photographs, were written; None where they are not."""
    summaries = [out / SUMMARY, out / POSES / SUMMARY]
    return [s.stat().st_mtime_ns if s.is_file() else None for s in summaries]
