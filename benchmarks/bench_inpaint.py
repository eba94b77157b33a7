"""Time and PSNR of the embedded hole filling and of other methods, in one run.

    python benchmarks/bench_inpaint.py benchmarks/development.json [--only NAME] [--pictures FOLDER]

All methods fill the same holes of the same warped image; PSNR (dB) is over the hole. The biharmonic
fill of scikit-image runs at half size, as it solves a dense system for each hole.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
import tyro
from jaxtyping import Float
from skimage.restoration import inpaint_biharmonic
from torch import Tensor

from apart import read_used_cases
from gscompleter.apps.report.pictures import join_images
from gscompleter.evaluation.cases import Case
from gscompleter.generators.warp import WarpedImage, warp_photographs
from gscompleter.generators.warp_inpaint import WarpInpaint
from gscompleter.numerics.image_ops import push_pull
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render.loading import load_renderer
from gscompleter.stages.select_anchor import find_nearest_view
from gscompleter.system.files.image import write_image
from gscompleter.types import GeneratorInput, View

Image = Float[Tensor, "h w 3"]
Method = Callable[[View, View, GeneratorInput, WarpedImage], Image]


def fill_ours(nearest: View, target: View, context: GeneratorInput, warped: WarpedImage) -> Image:
    return WarpInpaint()(nearest, target.camera, context)


def fill_averages(
    nearest: View, target: View, context: GeneratorInput, warped: WarpedImage
) -> Image:
    return push_pull(warped.image, warped.known.to(warped.image.dtype))


def make_opencv_method(flag: int) -> Method:
    """Make a method of cv2.inpaint with a radius of 5 pixels."""

    def fill(nearest: View, target: View, context: GeneratorInput, warped: WarpedImage) -> Image:
        image = (warped.image.numpy() * 255).round().astype(np.uint8)
        hole = (~warped.known).numpy().astype(np.uint8)
        return torch.from_numpy(cv2.inpaint(image, hole, 5, flag)).float() / 255

    return fill


def fill_biharmonic(
    nearest: View, target: View, context: GeneratorInput, warped: WarpedImage
) -> Image:
    h, w = warped.known.shape
    size = (w // 2, h // 2)
    image = cv2.resize(warped.image.numpy(), size, interpolation=cv2.INTER_AREA)
    hole = cv2.resize((~warped.known).numpy().astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    filled = inpaint_biharmonic(image, hole > 0, channel_axis=-1).astype(np.float32)
    whole = torch.from_numpy(cv2.resize(filled, (w, h), interpolation=cv2.INTER_LINEAR))
    return torch.where(warped.known[..., None], warped.image, whole.clamp(0, 1))


METHODS: dict[str, Method] = {
    "warp-inpaint": fill_ours,
    "pyramid of averages": fill_averages,
    "OpenCV Telea": make_opencv_method(cv2.INPAINT_TELEA),
    "OpenCV Navier-Stokes": make_opencv_method(cv2.INPAINT_NS),
    "scikit-image biharmonic": fill_biharmonic,
}


def load_known_scene(case: Case) -> tuple[View, View, GeneratorInput]:
    """Load the nearest photograph, the target photograph, and the reconstructed scene."""
    views, (target,) = case.load(case.context), case.load((case.target,))
    scene = load_reconstructor("plane-sweep")(views).gaussians
    renderer = load_renderer("cpu")
    context = GeneratorInput(
        tuple(views),
        tuple(renderer.render(scene, view.camera) for view in views),
        renderer.render(scene, target.camera),
    )
    return views[find_nearest_view(target.camera, views)], target, context


def main(
    cases: Annotated[Path, tyro.conf.Positional],
    only: str = "",
    pictures: Path | None = None,
    apart: bool = False,
) -> None:
    """Fill the holes of all cases with all methods and print means.

    Args:
        cases: A file of cases.
        only: Run only cases whose name contains this.
        pictures: Folder for one strip of images per case, the photograph last.
        apart: Use also what is kept apart, and note that in apart_uses.md.
    """
    scores: dict[str, list[float]] = {name: [] for name in METHODS}
    seconds: dict[str, list[float]] = {name: [] for name in METHODS}
    for number, case in enumerate(read_used_cases(cases, apart, only)):
        nearest, target, context = load_known_scene(case)
        warped = warp_photographs(nearest, target.camera, context)
        if warped.known.all():
            continue
        if number == 0:
            fill_ours(nearest, target, context, warped)  # compiles before the clock starts
        images = []
        for name, method in METHODS.items():
            start = time.perf_counter()
            image = method(nearest, target, context, warped)
            seconds[name].append(time.perf_counter() - start)
            error = ((image - target.image)[~warped.known] ** 2).mean()
            scores[name].append(-10 * error.log10().item())
            images.append(image)
        print(case.name, " ".join(f"{scores[name][-1]:6.2f}" for name in METHODS), flush=True)
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            name = case.name.replace(" ", "_").replace(">", "-")
            write_image(pictures / f"{name}.png", join_images([*images, target.image]))

    print(f"\n{'':24s} {'hole PSNR':>10s} {'worst loss':>11s} {'time':>9s} {'time ratio':>11s}")
    for name in METHODS:
        difference = [a - b for a, b in zip(scores["warp-inpaint"], scores[name], strict=True)]
        spent = statistics.mean(seconds[name])
        ratio = spent / statistics.mean(seconds["warp-inpaint"])
        print(
            f"{name:24s} {statistics.mean(scores[name]):7.2f} dB {min(difference):8.2f} dB "
            f"{spent:7.3f} s {ratio:10.2f} x"
        )
    print("worst loss: largest deficit (negative) of warp-inpaint in any case")


if __name__ == "__main__":
    tyro.cli(main)
