"""About how long a completion takes, stage by stage, so that it can be shown how far it is."""

from __future__ import annotations

from contextlib import AbstractContextManager

from gscompleter.commands.exploring import LIFTED_VIEWS
from gscompleter.commands.opening import Task
from gscompleter.commands.options import CompleteOptions, most
from gscompleter.commands.understood import SECONDS_PER_PIXEL
from gscompleter.progress import expecting
from gscompleter.reports.film import FRAMES, MAX_SIDE, MIN_WIDTH
from gscompleter.types import View

FINDING = 1.0
"""Seconds that it takes to find a target: the images that are looked at are small."""
REPORT = 1.0
"""Seconds that scenes, pictures and the page take, and for each image of the completion
`REPORT_PER_PIXEL` for each of its pixels."""
REPORT_PER_PIXEL = 3e-6
"""Drawing and writing what a camera sees before and after."""
FILM_PER_PIXEL = 1.2e-6
"""Seconds that a frame of the film takes for each pixel of one of its halves."""

CONTEXT = "context", 2.0
STAGES = ("generate", 1.0), ("lift", 1.0), ("register", 1.0), ("integrate", 2.0)
"""Stages of a target with their relative times, where none were measured. Rendering the context
comes first, once before all targets and once for each; report and film take as long as that."""


def expecting_completion(
    options: CompleteOptions, task: Task, device: str
) -> AbstractContextManager[None]:
    """Show inside how much of a completion is done, and how long it takes where that was measured:
    neither with other models, nor on a GPU, nor with a scene that was given."""
    embedded = options.reconstructor == "plane-sweep" and options.synthesis.name == "warp-inpaint"
    if task.scene is None and embedded and device == "cpu":
        return expecting(timed_stages(options, task))
    return expecting(stages_in_order(options, task), is_timed=False)


def stages_in_order(options: CompleteOptions, task: Task) -> list[tuple[str, float]]:
    """List what comes after the scene is opened, by the names that it is shown by, with its part of
    the time."""
    count = len(task.targets) or most(options)
    ends = [("report", CONTEXT[1]), *([("video", CONTEXT[1])] if options.video else [])]
    return [CONTEXT, *((CONTEXT, *STAGES) * count), *ends]


def timed_stages(options: CompleteOptions, task: Task) -> list[tuple[str, float]]:
    """List what comes after the scene is opened, by the names that it is shown by, in seconds."""
    count = len(task.targets) or most(options)
    context = SECONDS_PER_PIXEL * sum(pixels(view) for view in task.views)
    each = LIFTED_VIEWS * context / len(task.views) + (0 if task.targets else FINDING)
    pixel = pixels(task.views[0])
    report = REPORT + REPORT_PER_PIXEL * pixel * (len(task.views) + count)
    film = FILM_PER_PIXEL * max(min(pixel, MAX_SIDE**2), (MIN_WIDTH // 2) ** 2) * FRAMES
    stages = [("context", context), ("target", count * each), ("report", report)]
    return [*stages, ("video", film)] if options.video else stages


def pixels(view: View) -> int:
    """How many a photograph has."""
    return view.camera.width * view.camera.height
