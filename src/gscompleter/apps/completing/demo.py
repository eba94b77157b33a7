"""Completion of the stereo pair that scikit-image contains."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.demo import DemoOptions
from gscompleter.apps.completing.complete import complete_folder
from gscompleter.apps.completing.printing import answer_completion
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.report.completion import join_images
from gscompleter.data.demo_scene import write_motorcycle_scene
from gscompleter.system.console import make_console
from gscompleter.system.files.image import read_image, write_image
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.writing import SUMMARY_FILE, TARGETS_FILE

PICTURE_FILE = "before_after.png"
RESOLUTION = (250, 370)
COMMAND = "demo"
RESULTS = ("scene/**/*", "completion/**/*", PICTURE_FILE, SUMMARY_FILE)
"""Globs of the files that it may write."""


def name_scene(summary: Path, scene: Path) -> None:
    """Name the scene in the summary by its final place: the folder that is completed is moved."""
    content = json.loads(summary.read_bytes())
    content["settings"] |= {"folder": str(scene), "target": [str(scene / TARGETS_FILE)]}
    summary.write_bytes(json.dumps(content, indent=2).encode() + b"\n")


def complete_demo(options: DemoOptions) -> None:
    """Write the scene, complete it for both targets, and join before and after."""
    with (
        reserve_output(options.out, options.overwrite, COMMAND, RESULTS) as output,
        output.write() as folder,
    ):
        print_lines(make_console(stderr=True, quiet=options.quiet), *output.describe_others())
        scene = folder / "scene"
        write_motorcycle_scene(scene)
        complete_options = CompleteOptions(
            folder=scene,
            context=(0, 1),
            target=(str(scene / "targets.json"),),
            out=folder / "completion",
            resolution=RESOLUTION,
            device=options.device,
            seed=options.seed,
            quiet=options.quiet,
        )
        complete_folder(complete_options)
        name_scene(folder / "completion" / SUMMARY_FILE, options.out / "scene")

        # One row of four images: before and after at the first target, then at the second.
        images = folder / "completion" / "images"
        names = [f"target{n}_{when}" for n in (1, 2) for when in ("before", "after")]
        picture = join_images([read_image(images / f"{name}.png") for name in names])
        write_image(folder / PICTURE_FILE, picture)

    # `output.write` has moved the results from its temporary folder to OUT by now.
    done = replace(complete_options, out=options.out / "completion", json=options.json)
    answer_completion(done, {"before_after": str(options.out / PICTURE_FILE)})
    if not options.quiet and not options.json:
        print(f"Before and after, beyond either camera: {options.out / PICTURE_FILE}")
