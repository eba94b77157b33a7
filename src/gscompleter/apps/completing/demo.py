"""Completion of the stereo pair that scikit-image contains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gscompleter.apps.completing.complete import (
    answer_outcome,
    describe_completion_plan,
    prepare,
    write_completion,
)
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.report.pictures import IMAGES_FOLDER, join_images
from gscompleter.apps.report.results import COMPLETE_COMMAND
from gscompleter.apps.requests.completion import (
    CompletionRequest,
    ResultsRequest,
    TargetRequest,
    WorkRequest,
)
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.apps.requests.scene import PhotographsRequest, PosesRequest, SceneRequest
from gscompleter.data.demo_scene import write_motorcycle_scene
from gscompleter.system.console import make_console
from gscompleter.system.files.image import read_image, write_image
from gscompleter.system.files.output_folder import open_output_folder, reserve_output
from gscompleter.system.files.result_names import SUMMARY_FILE, TARGETS_FILE
from gscompleter.system.progress import show_progress

BEFORE_AFTER_FILE = "before_after.png"
DEMO_SIZE = (250, 370)
"""Height and width at which the pair is completed, in pixels: half of those of its photographs."""
DEMO_COMMAND = "demo"
DEMO_FILES = ("scene/**/*", "completion/**/*", BEFORE_AFTER_FILE, SUMMARY_FILE)
"""Globs of the files that the command may write."""


def make_request(folder: Path, models: ModelRequest, results: ResultsRequest) -> CompletionRequest:
    """Make the request for the completion in `folder` of the scene in it."""
    # The scene has cameras, so that none are searched for.
    source = PhotographsRequest(
        scene=SceneRequest(folder / "scene", resolution=DEMO_SIZE),
        poses=PosesRequest(folder / "completion"),
        context=(0, 1),
    )
    return CompletionRequest(
        source=source,
        work=WorkRequest(models=models),
        targets=TargetRequest((str(folder / "scene" / TARGETS_FILE),)),
        results=ResultsRequest(out=folder / "completion", answer=results.answer),
    )


def complete_demo(models: ModelRequest, results: ResultsRequest) -> int:
    """Write the scene, complete it for both targets, and join before and after.

    Returns the exit code.
    """
    answer = results.answer
    out = results.out
    console = make_console(stderr=True, quiet=answer.quiet)
    with (
        show_progress(console),
        reserve_output(out, results.overwrite, DEMO_COMMAND, DEMO_FILES) as output,
        output.write() as folder,
    ):
        print_lines(console, *output.describe_others())
        write_motorcycle_scene(folder / "scene")
        ready = prepare(make_request(folder, models, results), console)
        # `folder` is temporary and becomes OUT at the end: what is printed and written names OUT.
        # Photographs that are still to be read keep their present paths.
        lasting = make_request(out, models, results)
        ready = replace(
            ready,
            source=lasting.source,
            targets=lasting.targets,
            results=lasting.results,
            opened=replace(
                ready.opened, request=replace(ready.opened.request, folder=out / "scene")
            ),
        )
        print_lines(console, *describe_completion_plan(ready))
        with open_output_folder(folder / "completion", command=COMPLETE_COMMAND) as completion:
            write_completion(completion, ready)

        # One row of four images: before and after at the first target, then at the second.
        images = folder / "completion" / IMAGES_FOLDER
        names = [f"target{number}_{when}" for number in (1, 2) for when in ("before", "after")]
        picture = join_images([read_image(images / f"{name}.png") for name in names])
        write_image(folder / BEFORE_AFTER_FILE, picture)

    # `output.write` has moved the results from its temporary folder to OUT by now.
    code = answer_outcome(lasting.results, {"before_after": str(out / BEFORE_AFTER_FILE)})
    if not answer.quiet and not answer.json:
        print(f"Before and after, beyond either camera: {out / BEFORE_AFTER_FILE}")
    return code
