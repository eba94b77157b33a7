"""Does support find what is wrong of a trained splat? And what does completing it change?

    python benchmarks/support.py SCENE SPLAT TRAIN_TXT [--complete FRAME ...]

SCENE are posed photographs, SPLAT was trained on those of them that TRAIN_TXT names. For each of
the others: the share of pixels that are wrong (the colour is off by more than 0.1, over a few
pixels, once the exposure is fitted) and the area under the ROC curve of support, told by all
photographs but that one, and by those of the training alone. With --complete these frames are
completed, each by itself, from the 8 photographs that stand closest; the others are witnesses.
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
from gscompleter.metrics.image import psnr
from gscompleter.render import load_renderer
from gscompleter.splats.formats import load_splat
from gscompleter.stages.context import depth_range_of_scene
from gscompleter.stages.support import (
    believed_alpha,
    difference,
    gather_evidence,
    support,
    weight_sums,
)
from gscompleter.types import Evidence, Gaussians, Proxy, View

LONG_SIDE = 320
WRONG = 0.1
CONTEXT = 8


def main() -> None:
    """Print a row per photograph that the splat was not trained on."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("splat", type=Path)
    parser.add_argument("train", type=Path)
    parser.add_argument("--complete", type=int, nargs="*", default=[])
    asked = parser.parse_args()
    photographs = open_photographs(asked.scene)
    names = [Path(str(frame.image)).name for frame in photographs.frames]
    trained = [n for n, name in enumerate(names) if name in asked.train.read_text().split()]
    views = photographs.views(list(range(len(names))), LONG_SIDE)
    scene = load_splat(asked.splat)
    near, far = depth_range_of_scene(scene, [v.camera for v in views], load_renderer("cpu"))
    views = [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]
    find(scene, views, trained)
    for frame in asked.complete:
        complete(scene, views, frame, trained)


def find(scene: Gaussians, views: Sequence[View], trained: Sequence[int]) -> None:
    """How well support finds wrong pixels."""
    renderer, config = load_renderer("cpu"), TrustConfig()
    frozen_views = [renderer.freeze(scene, view.camera) for view in views]
    evidence = gather_evidence(Proxy(scene), views, frozen_views, config)
    for frame in sorted(set(range(len(views))) - set(trained)):
        view = views[frame]
        frozen = frozen_views[frame]
        wrong, sums = difference(frozen.context, view) > WRONG, weight_sums(frozen)
        areas = []
        for told in ([n for n in range(len(views)) if n != frame], list(trained)):
            told_of = chosen(evidence, told)
            known = support(told_of, sums, view.camera, config)
            areas.append(roc(believed_alpha(frozen, known), wrong))
        share = wrong.float().mean().item()
        print(f"{frame}: wrong {share:.3f}, by all others {areas[0]:.3f}, trained {areas[1]:.3f}")


def chosen(evidence: Evidence, told: list[int]) -> Evidence:
    """What some of the photographs say."""
    parts = (evidence.centers, evidence.areas, evidence.agreement)
    return Evidence(evidence.proxy, *(part[told] for part in parts))


def roc(believed: Tensor, wrong: Tensor) -> float:
    """Area under the ROC curve of little belief for being wrong."""
    ranks = believed.flatten().argsort(descending=True).argsort().double() + 1
    bad = wrong.flatten()
    positives, negatives = int(bad.sum()), int((~bad).sum())
    if not positives or not negatives:
        return float("nan")
    rank_sum = ranks[bad].sum().item()
    return (rank_sum - positives * (positives + 1) / 2) / (positives * negatives)


def complete(scene: Gaussians, views: Sequence[View], frame: int, trained: Sequence[int]) -> None:
    """Complete the scene for a frame and compare all photographs before and after."""
    target = views[frame]
    others = [n for n in range(len(views)) if n != frame]
    remoteness = {n: (views[n].camera.center - target.camera.center).norm().item() for n in others}
    context = sorted(sorted(others, key=remoteness.__getitem__)[:CONTEXT])
    witnesses = [views[n] for n in others if n not in context]
    views_in = [views[n] for n in context]
    completion = GSCompleter()(views_in, target.camera, scene, witnesses)
    renderer = load_renderer("cpu")

    def gain(n: int) -> float:
        before, after = (
            psnr(renderer.render(s, views[n].camera).image, views[n].image)
            for s in (scene, completion.scene)
        )
        return after - before

    of_trained = [gain(n) for n in trained]
    of_others = [gain(n) for n in others if n not in trained]
    aside = 0 if completion.set_aside is None else int(completion.set_aside.sum())
    print(
        f"completed for {frame}: {gain(frame):+.2f} dB there; "
        f"trained {min(of_trained):+.3f} at worst, {sum(of_trained) / len(of_trained):+.3f} mean; "
        f"others {min(of_others):+.2f} at worst, {sum(of_others) / len(of_others):+.2f} mean; "
        f"{len(completion.added)} added, {aside} aside, {completion.seconds['total']:.0f} s",
        flush=True,
    )


if __name__ == "__main__":
    main()
