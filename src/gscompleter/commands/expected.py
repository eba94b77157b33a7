"""About how long a completion takes, stage by stage, so that it can be shown how far it is."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.commands.exploring import LIFTED_VIEWS
from gscompleter.commands.opening import Task
from gscompleter.commands.options import CompleteOptions, most
from gscompleter.commands.understood import SECONDS_PER_PIXEL
from gscompleter.reports.film import FRAMES, MAX_SIDE
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


def expected(options: CompleteOptions, task: Task, device: str) -> Sequence[tuple[str, float]]:
    """By the names that they are shown by, what comes after the scene is opened, in seconds; empty
    where it was not measured: with other models, on a GPU, or with a scene that was brought."""
    embedded = options.reconstructor == "plane-sweep" and options.synthesis.name == "warp-inpaint"
    if task.scene is not None or not embedded or device != "cpu":
        return ()
    count = len(task.targets) or most(options)
    context = SECONDS_PER_PIXEL * sum(pixels(view) for view in task.views)
    each = LIFTED_VIEWS * context / len(task.views) + (0 if task.targets else FINDING)
    pixel = pixels(task.views[0])
    report = REPORT + REPORT_PER_PIXEL * pixel * (len(task.views) + count)
    film = FILM_PER_PIXEL * min(pixel, MAX_SIDE**2) * FRAMES
    stages = [("context", context), ("target", count * each), ("report", report)]
    return [*stages, ("film", film)] if options.film else stages


def pixels(view: View) -> int:
    """How many a photograph has."""
    return view.camera.width * view.camera.height
