"""Given splats that lack what their photographs show, before and after.

    python benchmarks/bench_observed.py cut      [--data ../shared]
    python benchmarks/bench_observed.py trained  [--data ../shared] [--splats DIR] [--pictures DIR]

`cut` removes a sphere from a trained splat: photographs that it was trained on show what is gone,
and others score. `trained` fits a splat to six photographs by a plain loop (the baseline `densify`)
and completes it at targets between them; held-back photographs score. PSNR in dB.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
from PIL import Image

from apart import HELP, select_scenes
from gscompleter import (
    CompleterConfig,
    Completion,
    Gaussians,
    GSCompleter,
    View,
    load_reconstructor,
    load_renderer,
    load_splat,
    load_views,
    save_splat,
)
from gscompleter.evaluation.baselines.optimization import OptimizationConfig, optimize
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.render.lod import thin_gaussians

RENDERER = load_renderer("cpu")
CUT_SIZE = 320
CUT_RADIUS = 0.18
"""Radius of the sphere, relative to its distance from the middle photograph."""
TRAINED_SIZE = 240
FIRST_GAUSSIANS = 3000
"""Gaussians that the plain loop begins with, as many as a sparse model has points."""
# Context, targets and held-back frames: one in three is not trained on.
TRAINED = {
    "fountain_p11": ((0, 1, 3, 4, 6, 7), (2, 5), (2, 5, 8)),
    "redkitchen": ((10, 12, 14, 16, 18, 20), (13, 17), (11, 13, 15, 17, 19)),
    "kitti_city": ((30, 31, 33, 34, 36, 37), (32, 35), (32, 35, 38)),
}


def score(scene: Gaussians, views: Sequence[View]) -> list[float]:
    """Return the PSNR of a scene at each photograph."""
    images = [RENDERER.render(scene, view.camera).image.clamp(0, 1) for view in views]
    return [psnr(image, view.image) for image, view in zip(images, views, strict=True)]


def describe_change(name: str, before: Sequence[float], after: Sequence[float]) -> str:
    """Write the means before and after, and the worst change."""
    worst = min(b - a for a, b in zip(before, after, strict=True))
    return f"{name}: {fmean(before):.2f} -> {fmean(after):.2f} (worst {worst:+.3f})"


def measure_cut(data: Path) -> None:
    """Cut a sphere out of the fox, add what its training photographs show, and score."""
    folder = data / "splats" / "fox"
    trained = set((folder / "train.txt").read_text().split())
    names = sorted(path.name for path in (folder / "images").iterdir())
    frames = range(len(names))
    views = load_views(folder, [i for i in frames if names[i] in trained], CUT_SIZE)
    others = load_views(folder, [i for i in frames if names[i] not in trained], CUT_SIZE)
    whole = load_splat(folder / "splat.ply")

    # The sphere lies where the middle photograph looks.
    middle = views[len(views) // 2].camera
    depth = RENDERER.render(whole, middle).depth
    row, column = depth.shape[0] // 2, depth.shape[1] // 2
    distance = depth[row - 10 : row + 10, column - 10 : column + 10].median()
    centre = middle.center + middle.forward * distance
    is_gone = (whole.means - centre).norm(dim=1) < CUT_RADIUS * distance
    cut = whole[~is_gone]

    start = time.monotonic()
    state = GSCompleter(config=CompleterConfig.splat()).begin(views, cut, check_views=[])
    print(f"cut {int(is_gone.sum())}, added {state.num_observed}, {time.monotonic() - start:.0f} s")
    for name, photos in (("training photographs", views), ("others", others)):
        before, after, goal = (score(scene, photos) for scene in (cut, state.scene, whole))
        print(describe_change(name, before, after))
        print(describe_change("  from the whole splat", goal, after))


def train_splat(views: Sequence[View]) -> Gaussians:
    """Fit a splat to photographs by a plain loop with density control."""
    reconstruction = load_reconstructor("plane-sweep")(views)
    first = thin_gaussians(reconstruction.gaussians, FIRST_GAUSSIANS)
    settings = OptimizationConfig(iterations=300)
    return optimize(first, views, RENDERER, config=settings).detach()


def find_splat(folder: Path | None, name: str, views: Sequence[View]) -> Gaussians:
    """Read the splat of an earlier run, or train it and keep it in `folder`."""
    if folder is None:
        return train_splat(views)
    path = folder / f"{name}.ply"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        save_splat(path, train_splat(views))
    return load_splat(path)


def measure_trained(
    data: Path, splats: Path | None, pictures: Path | None, uses_apart: bool
) -> None:
    """Complete splats of a plain loop at targets between their photographs, and score."""
    used = select_scenes(TRAINED, uses_apart)
    for name, (context, targets, held_back) in TRAINED.items():
        if name not in used:
            continue
        views = load_views(data / "data" / name, context, TRAINED_SIZE)
        others = load_views(data / "data" / name, held_back, TRAINED_SIZE)
        splat = find_splat(splats, name, views)
        start = time.monotonic()
        completer = GSCompleter(config=CompleterConfig.splat())
        cameras = [view.camera for view in others]
        goals = [cameras[held_back.index(frame)] for frame in targets]
        state = completer(views, goals, splat, check_views=[])
        seconds = time.monotonic() - start
        print(f"{name}: {len(splat)} Gaussians, {state.num_observed} observed, {seconds:.0f} s")
        for title, photos in (("trained", views), ("held back", others)):
            print("  " + describe_change(title, score(splat, photos), score(state.scene, photos)))
        for result in state.targets:
            share = result.unfilled.share
            print(
                f"  target: hole {result.hole_fraction:.1%}, added {len(result.added)}, "
                f"open {share:.1%}; {' '.join(result.notes)}"
            )
        if pictures:
            save_pictures(pictures / f"{name}.png", splat, state, others)


def save_pictures(path: Path, splat: Gaussians, state: Completion, views: Sequence[View]) -> None:
    """Save photograph, splat and completion of each held-back camera, side by side."""
    rows = []
    for view in views:
        images = [view.image]
        images += [RENDERER.render(s, view.camera).image.clamp(0, 1) for s in (splat, state.scene)]
        rows.append(np.concatenate([(255 * image.numpy()).astype(np.uint8) for image in images], 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path)


def main() -> None:
    """Run one of the two measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("cut", "trained"))
    parser.add_argument("--data", type=Path, default=Path("../shared"))
    parser.add_argument("--splats", type=Path, help="folder that keeps the trained splats")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--apart", action="store_true", help=HELP)
    options = parser.parse_args()
    if options.what == "cut":
        measure_cut(options.data)
    else:
        measure_trained(options.data, options.splats, options.pictures, options.apart)


if __name__ == "__main__":
    main()
