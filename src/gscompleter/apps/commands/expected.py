"""Expected times of the stages, for the progress line."""

from __future__ import annotations

from contextlib import AbstractContextManager

from gscompleter.apps.commands.exploring import LIFTED_VIEWS
from gscompleter.apps.commands.options import CompleteOptions, get_max_targets
from gscompleter.apps.inputs.opening import Task
from gscompleter.apps.inputs.plan import SECONDS_PER_PIXEL
from gscompleter.apps.report.film import MAX_SIDE, MIN_WIDTH, ONE_WAY_FRAMES
from gscompleter.progress import expect_stages
from gscompleter.types import View

FINDING_SECONDS = 1.0
REPORT_SECONDS = 1.0
"""Seconds to write scenes, pictures and the page, without `REPORT_SECONDS_PER_PIXEL`."""
REPORT_SECONDS_PER_PIXEL = 3e-6
"""Seconds per pixel to render and write a camera before and after."""
VIDEO_SECONDS_PER_PIXEL = 1.2e-6
"""Seconds per pixel and frame of one half of the video."""

CONTEXT = "context", 2.0
STAGES = ("generate", 1.0), ("lift", 1.0), ("register", 1.0), ("integrate", 2.0)
"""Stages of a target with their relative times."""


def expect_completion(
    options: CompleteOptions, task: Task, device: str
) -> AbstractContextManager[None]:
    """Show the progress of a completion inside the block, with times if they are known.

    Times are known for the default models on a CPU without an input splat.
    """
    embedded = options.reconstructor == "plane-sweep" and options.synthesis.name == "warp-inpaint"
    if task.scene is None and embedded and device == "cpu":
        return expect_stages(list_timed_stages(options, task))
    return expect_stages(list_stages(options, task), is_timed=False)


def list_stages(options: CompleteOptions, task: Task) -> list[tuple[str, float]]:
    """List the stages after opening the scene with their relative times."""
    count = len(task.targets) or get_max_targets(options)
    ends = [("report", CONTEXT[1]), *([("video", CONTEXT[1])] if options.video else [])]
    return [CONTEXT, *((CONTEXT, *STAGES) * count), *ends]


def list_timed_stages(options: CompleteOptions, task: Task) -> list[tuple[str, float]]:
    """List the stages after opening the scene with their seconds."""
    count = len(task.targets) or get_max_targets(options)
    context = SECONDS_PER_PIXEL * sum(count_pixels(view) for view in task.views)
    each = LIFTED_VIEWS * context / len(task.views) + (0 if task.targets else FINDING_SECONDS)
    pixel = count_pixels(task.views[0])
    report = REPORT_SECONDS + REPORT_SECONDS_PER_PIXEL * pixel * (len(task.views) + count)
    film = (
        VIDEO_SECONDS_PER_PIXEL
        * max(min(pixel, MAX_SIDE**2), (MIN_WIDTH // 2) ** 2)
        * ONE_WAY_FRAMES
    )
    stages = [("context", context), ("target", count * each), ("report", report)]
    return [*stages, ("video", film)] if options.video else stages


def count_pixels(view: View) -> int:
    """Count the pixels of a photograph."""
    return view.camera.width * view.camera.height
