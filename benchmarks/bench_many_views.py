"""The default reconstructor on many photographs at once, and on merged pairs of them.

    python benchmarks/bench_many_views.py $GSCOMPLETER_DATA/data/fox --views 4 8 16 32

Scores at 256 x 256 are for the given photographs and for those halfway between two of them, each
with its best exposure gain per channel.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

import gscompleter as gsc
from apart import HELP, select_scenes
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.reconstructors.features.depth_range import get_depth_range
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.types import Gaussians, View, merge

DATA = Path(os.environ.get("GSCOMPLETER_DATA", "../shared"))
SIZE = 256, 256


def reconstruct_jointly(views: Sequence[View]) -> Gaussians:
    return PlaneSweep()(views).gaussians


def reconstruct_by_pairs(views: Sequence[View]) -> Gaussians:
    """Reconstruct pairs of neighbouring photographs and merge them, as two-view models do."""
    pairs = [views[i : i + 2] for i in range(0, len(views) - 1, 2)]
    return merge([PlaneSweep()(pair).gaussians for pair in pairs])


def load_spread_views(scene: Path, count: int) -> tuple[list[View], list[View]]:
    """Load `count` evenly spread photographs and those halfway between, with one depth range."""
    last = len(gsc.load_views(scene, resolution=(16, 16))) - 1
    given = np.linspace(0, last, count).round().astype(int).tolist()
    middle = {(a + b) // 2 for a, b in pairwise(given)} - set(given)
    views, between = (
        gsc.load_views(scene, frames=frames, resolution=SIZE) for frames in (given, sorted(middle))
    )
    near, far = get_depth_range(views)
    return set_depth_range(views, near, far), set_depth_range(between, near, far)


def set_depth_range(views: Sequence[View], near: float, far: float) -> list[View]:
    return [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]


def compute_scores(gaussians: Gaussians, views: Sequence[View]) -> list[float]:
    """Compute PSNR (dB) at each view, in its exposure."""
    renderer = gsc.load_renderer("cpu")
    images = [renderer.render(gaussians, view.camera).image for view in views]
    return [
        psnr(match_exposure(v.image, image), v.image)
        for image, v in zip(images, views, strict=True)
    ]


def match_exposure(
    photograph: Float[Tensor, "h w 3"], image: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w 3"]:
    """Multiply each channel of `image` by its best gain for `photograph`."""
    return image * (image * photograph).sum((0, 1)) / image.square().sum((0, 1))


def print_row(
    name: str, make: Callable[[Sequence[View]], Gaussians], scene: Path, count: int
) -> None:
    views, between = load_spread_views(scene, count)
    start = time.perf_counter()
    made = make(views)
    seconds = time.perf_counter() - start
    given, others = compute_scores(made, views), compute_scores(made, between) or [float("nan")]
    print(
        f"| {scene.name} | {name} | {count} | {seconds:.1f} | {seconds / count:.2f} | "
        f"{len(made) / 1000:.0f} | {np.mean(given):.2f} ({min(given):.2f}) | "
        f"{np.mean(others):.2f} ({min(others):.2f}) |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Photographs to Gaussians, of many views.")
    parser.add_argument("scenes", nargs="*", type=Path, default=[DATA / "data" / "fox"])
    parser.add_argument("--views", nargs="+", type=int, default=[4, 8, 16])
    parser.add_argument("--apart", action="store_true", help=HELP)
    given = parser.parse_args()
    used = select_scenes([scene.name for scene in given.scenes], given.apart)
    columns = ("scene", "", "views", "s", "s a view", "1000 Gaussians")
    print(f"| {' | '.join(columns)} | given, dB (worst) | between (worst) |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for scene in (scene for scene in given.scenes if scene.name in used):
        for count in given.views:
            print_row("jointly", reconstruct_jointly, scene, count)
            print_row("by pairs", reconstruct_by_pairs, scene, count)


if __name__ == "__main__":
    main()
