"""Completion of the stereo pair that scikit-image contains."""

from __future__ import annotations

import json
from pathlib import Path

from gscompleter.apps.completing.complete import complete_folder
from gscompleter.apps.completing.printing import answer_completion
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.report.pictures import join_images
from gscompleter.apps.requests.answer import AnswerRequest
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
RESOLUTION = (250, 370)
DEMO_COMMAND = "demo"
DEMO_FILES = ("scene/**/*", "completion/**/*", BEFORE_AFTER_FILE, SUMMARY_FILE)
"""Globs of the files that it may write."""


def name_scene(summary: Path, scene: Path) -> None:
    """Name the scene in the summary by its final place: the folder that is completed is moved."""
    content = json.loads(summary.read_bytes())
    content["settings"] |= {"folder": str(scene), "target": [str(scene / TARGETS_FILE)]}
    summary.write_bytes(json.dumps(content, indent=2).encode() + b"\n")


def complete_demo(models: ModelRequest, results: ResultsRequest) -> None:
    """Write the scene, complete it for both targets, and join before and after."""
    answer = results.answer
    out = results.out
    with (
        reserve_output(out, results.overwrite, DEMO_COMMAND, DEMO_FILES) as output,
        output.write() as folder,
    ):
        print_lines(make_console(stderr=True, quiet=answer.quiet), *output.describe_others())
        scene = folder / "scene"
        write_motorcycle_scene(scene)
        inside = ResultsRequest(out=folder / "completion", answer=AnswerRequest(answer.quiet))
        complete_folder(
            CompletionRequest(
                source=PhotographsRequest(
                    SceneRequest(scene, resolution=RESOLUTION), PosesRequest(inside.out), (0, 1)
                ),
                work=WorkRequest(models=models),
                targets=TargetRequest((str(scene / TARGETS_FILE),)),
                results=inside,
            )
        )
        name_scene(inside.out / SUMMARY_FILE, out / "scene")

        # One row of four images: before and after at the first target, then at the second.
        images = inside.out / "images"
        names = [f"target{n}_{when}" for n in (1, 2) for when in ("before", "after")]
        picture = join_images([read_image(images / f"{name}.png") for name in names])
        write_image(folder / BEFORE_AFTER_FILE, picture)

    # `output.write` has moved the results from its temporary folder to OUT by now.
    done = ResultsRequest(out=out / "completion", answer=answer)
    answer_completion(done, {"before_after": str(out / BEFORE_AFTER_FILE)})
    if not answer.quiet and not answer.json:
        print(f"Before and after, beyond either camera: {out / BEFORE_AFTER_FILE}")
