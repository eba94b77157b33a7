"""Measure trust against the errors of a trained splat, and the PSNR of completions.

    python benchmarks/support.py SCENE SPLAT TRAIN_TXT [--complete FRAME ...]

SPLAT was trained on the photographs of SCENE that TRAIN_TXT names. For each other photograph the
script prints the share of wrong pixels (colour error above 0.1 after exposure fitting) and the area
under the ROC curve of trust, computed from all other photographs and from the training ones. Frames
after --complete are completed one by one from the 8 nearest photographs; the others are check
views.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from gscompleter.completer import GSCompleter
from gscompleter.config import TrustConfig
from gscompleter.data.formats import open_photographs
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.render import load_renderer
from gscompleter.splats.formats import load_splat
from gscompleter.stages.context import measure_depth_range
from gscompleter.trust.photometric import (
    compute_color_difference,
    compute_trust,
    compute_trusted_alpha,
    gather_observations,
    sum_weights,
)
from gscompleter.types import Gaussians, PhotoObservations, Proxy, View

LONG_SIDE = 320
WRONG = 0.1
CONTEXT = 8


def main() -> None:
    """Print one row per photograph that is not a training photograph."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("splat", type=Path)
    parser.add_argument("train", type=Path)
    parser.add_argument("--complete", type=int, nargs="*", default=[])
    options = parser.parse_args()
    photographs = open_photographs(options.scene)
    names = [Path(str(frame.image)).name for frame in photographs.frames]
    trained = [n for n, name in enumerate(names) if name in options.train.read_text().split()]
    views = photographs.views(list(range(len(names))), LONG_SIDE)
    scene = load_splat(options.splat)
    near, far = measure_depth_range(scene, [v.camera for v in views], load_renderer("cpu"))
    views = [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]
    find(scene, views, trained)
    for frame in options.complete:
        complete(scene, views, frame, trained)


def find(scene: Gaussians, views: Sequence[View], trained: Sequence[int]) -> None:
    renderer, config = load_renderer("cpu"), TrustConfig()
    frozen_views = [renderer.freeze(scene, view.camera) for view in views]
    evidence = gather_observations(Proxy(scene), views, frozen_views, config)
    for frame in sorted(set(range(len(views))) - set(trained)):
        view = views[frame]
        frozen = frozen_views[frame]
        wrong, sums = compute_color_difference(frozen.render, view) > WRONG, sum_weights(frozen)
        areas = []
        for numbers in ([n for n in range(len(views)) if n != frame], list(trained)):
            part = select_evidence(evidence, numbers)
            trust = compute_trust(part, sums, view.camera, config)
            areas.append(compute_roc_area(compute_trusted_alpha(frozen, trust), wrong))
        share = wrong.float().mean().item()
        print(f"{frame}: wrong {share:.3f}, by all others {areas[0]:.3f}, trained {areas[1]:.3f}")


def select_evidence(evidence: PhotoObservations, numbers: list[int]) -> PhotoObservations:
    parts = (evidence.centers, evidence.areas, evidence.agreement)
    return PhotoObservations(evidence.proxy, *(part[numbers] for part in parts))


def compute_roc_area(alpha: Tensor, wrong: Tensor) -> float:
    """Compute the area under the ROC curve of low alpha as a sign of wrong pixels."""
    ranks = alpha.flatten().argsort(descending=True).argsort().double() + 1
    bad = wrong.flatten()
    positives, negatives = int(bad.sum()), int((~bad).sum())
    if not positives or not negatives:
        return float("nan")
    rank_sum = ranks[bad].sum().item()
    return (rank_sum - positives * (positives + 1) / 2) / (positives * negatives)


def complete(scene: Gaussians, views: Sequence[View], frame: int, trained: Sequence[int]) -> None:
    target = views[frame]
    others = [n for n in range(len(views)) if n != frame]
    remoteness = {n: (views[n].camera.center - target.camera.center).norm().item() for n in others}
    context = sorted(sorted(others, key=remoteness.__getitem__)[:CONTEXT])
    check_views = [views[n] for n in others if n not in context]
    views_in = [views[n] for n in context]
    completion = GSCompleter()(views_in, target.camera, scene, check_views)
    renderer = load_renderer("cpu")

    def gain(n: int) -> float:
        before, after = (
            psnr(renderer.render(s, views[n].camera).image, views[n].image)
            for s in (scene, completion.scene)
        )
        return after - before

    of_trained = [gain(n) for n in trained]
    of_others = [gain(n) for n in others if n not in trained]
    pruned = 0 if completion.pruned is None else int(completion.pruned.sum())
    print(
        f"completed for {frame}: {gain(frame):+.2f} dB there; "
        f"trained {min(of_trained):+.3f} at worst, {sum(of_trained) / len(of_trained):+.3f} mean; "
        f"others {min(of_others):+.2f} at worst, {sum(of_others) / len(of_others):+.2f} mean; "
        f"{len(completion.added)} added, {pruned} pruned, {completion.seconds['total']:.0f} s",
        flush=True,
    )


if __name__ == "__main__":
    main()
