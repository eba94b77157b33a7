"""Completion of the stereo pair that scikit-image contains."""

from __future__ import annotations

import json
from pathlib import Path

from gscompleter.apps.completing.complete import answer_outcome, complete_folder
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.report.page import write_completion_page
from gscompleter.apps.report.pictures import IMAGES_FOLDER, join_images
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
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.writing import SUMMARY_FILE, TARGETS_FILE

BEFORE_AFTER_FILE = "before_after.png"
DEMO_SIZE = (250, 370)
"""Height and width at which the pair is completed, in pixels: half of those of its photographs."""
DEMO_COMMAND = "demo"
DEMO_FILES = ("scene/**/*", "completion/**/*", BEFORE_AFTER_FILE, SUMMARY_FILE)
"""Globs of the files that the command may write."""


def name_scene(completion: Path, scene: Path) -> None:
    """Name the scene in the summary and the report of its completion by where it will lie.

    It was completed in the temporary folder that becomes OUT at the end.
    """
    summary = completion / SUMMARY_FILE
    content = json.loads(summary.read_bytes())
    content["settings"] |= {"folder": str(scene), "target": [str(scene / TARGETS_FILE)]}
    summary.write_bytes(json.dumps(content, indent=2).encode() + b"\n")
    # The page is made of the summary.
    write_completion_page(completion)


def complete_demo(models: ModelRequest, results: ResultsRequest) -> int:
    """Write the scene, complete it for both targets, and join before and after.

    Returns the exit code.
    """
    answer = results.answer
    out = results.out
    with (
        reserve_output(out, results.overwrite, DEMO_COMMAND, DEMO_FILES) as output,
        output.write() as folder,
    ):
        print_lines(make_console(stderr=True, quiet=answer.quiet), *output.describe_others())
        scene = folder / "scene"
        write_motorcycle_scene(scene)
        completion = folder / "completion"
        # The scene has cameras, so that none are searched for.
        source = PhotographsRequest(
            scene=SceneRequest(scene, resolution=DEMO_SIZE),
            poses=PosesRequest(completion),
            context=(0, 1),
        )
        complete_folder(
            CompletionRequest(
                source=source,
                work=WorkRequest(models=models),
                targets=TargetRequest((str(scene / TARGETS_FILE),)),
                results=ResultsRequest(out=completion, answer=answer),
            )
        )
        name_scene(completion, out / "scene")

        # One row of four images: before and after at the first target, then at the second.
        images = completion / IMAGES_FOLDER
        names = [f"target{number}_{when}" for number in (1, 2) for when in ("before", "after")]
        picture = join_images([read_image(images / f"{name}.png") for name in names])
        write_image(folder / BEFORE_AFTER_FILE, picture)

    # `output.write` has moved the results from its temporary folder to OUT by now.
    moved = ResultsRequest(out=out / "completion", answer=answer)
    code = answer_outcome(moved, {"before_after": str(out / BEFORE_AFTER_FILE)})
    if not answer.quiet and not answer.json:
        print(f"Before and after, beyond either camera: {out / BEFORE_AFTER_FILE}")
    return code
