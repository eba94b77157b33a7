"""Completion of the stereo pair that scikit-image contains.

It is the Middlebury 2014 motorcycle pair, downsampled by four, with its calibration (Scharstein et
al., GCPR 2014).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console
from skimage.data import stereo_motorcycle

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.demo import DemoOptions
from gscompleter.apps.completing.complete import complete_folder
from gscompleter.apps.completing.printing import answer_completion
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.report.completion import join_images
from gscompleter.data.scene import write_cameras
from gscompleter.system.files.image import read_image, write_image
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.writing import SUMMARY_FILE
from gscompleter.types import Camera

PICTURE_FILE = "before_after.png"
FOCAL_PX = 994.978
PRINCIPAL_POINT_PX = (311.193, 254.877)
PRINCIPAL_POINT_DX_PX = 31.086
"""Offset of the right image's principal point, in pixels."""
BASELINE_M = 0.193001
RESOLUTION = (250, 370)
COMMAND = "demo"
RESULTS = ("scene/**/*", "completion/**/*", PICTURE_FILE, SUMMARY_FILE)
"""Globs of the files that it may write."""


def get_motorcycle_cameras(width: int, height: int) -> tuple[Camera, Camera]:
    """Return the left and right camera in metres; the left one is the world frame.

    The pair is rectified: both cameras have the same focal length and axes, and the right one only
    another principal point.
    """
    K = torch.diag(torch.tensor([FOCAL_PX, FOCAL_PX, 1.0]))
    K[:2, 2] = torch.tensor(PRINCIPAL_POINT_PX)
    left = Camera(torch.eye(4), K, width, height)
    K_right = K.clone()
    K_right[0, 2] += PRINCIPAL_POINT_DX_PX
    return left, replace(move_right(left, BASELINE_M), K=K_right)


def move_right(camera: Camera, x: float) -> Camera:
    """Move a camera by `x` metres to the right."""
    c2w = camera.c2w.clone()
    c2w[0, 3] += x
    return replace(camera, c2w=c2w)


def write_motorcycle_scene(folder: Path) -> None:
    """Write the pair as a scene folder with `targets.json`."""
    left_image, right_image, _ = stereo_motorcycle()
    height, width = left_image.shape[:2]
    left, right = get_motorcycle_cameras(width, height)
    (folder / "images").mkdir(parents=True)
    for name, image in (("left", left_image), ("right", right_image)):
        write_image(folder / "images" / f"{name}.png", torch.from_numpy(image / 255).float())
    write_cameras(
        folder / "transforms.json", [left, right], ["images/left.png", "images/right.png"]
    )

    # Two targets, each a baseline beyond one of the cameras: they look behind what both
    # photographs show in front.
    beyond = [move_right(left, -BASELINE_M), move_right(right, BASELINE_M)]
    write_cameras(folder / "targets.json", beyond)


def complete_demo(options: DemoOptions) -> None:
    """Write the scene, complete it for both targets, and join before and after."""
    with (
        reserve_output(options.out, options.overwrite, COMMAND, RESULTS) as output,
        output.write() as folder,
    ):
        print_lines(Console(stderr=True, quiet=options.quiet), *output.describe_others())
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
