"""Further photographs against the pair alone, on the development cases and on held-out ones.

    GSCOMPLETER_DATA=DIR python benchmarks/bench_many.py pair nearest-3 spread-3
    GSCOMPLETER_DATA=DIR python benchmarks/bench_many.py pair nearest-3 --held-out --apart

Each case is reconstructed and completed from the pair and from more photographs. What the *pair*
leaves open of the target counts as the hole in all rows, so that they are comparable; `gscompleter
evaluate benchmarks/many/nearest-3.json` scores each with its own hole.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from statistics import mean

import torch
from jaxtyping import Bool
from torch import Tensor

from apart import HELP, read_used_cases
from choose_many import add_photographs
from gscompleter.config.settings import COVERED
from gscompleter.evaluation.cases import Case
from gscompleter.evaluation.metrics.image import compute_masked_psnr
from gscompleter.evaluation.protocols import make_case_task
from gscompleter.evaluation.runner import RunConfig, load_task_views
from gscompleter.reconstructors.features.depth_range import set_depth_range
from gscompleter.stages.context import normalize_exposures, reconstruct_context, sort_by_frame
from gscompleter.types import Gaussians, View

HELD_OUT = Path(__file__).with_name("held_out.json")
DEVELOPMENT = Path(__file__).with_name("development.json")
MIN_HOLE = 50
"""Smallest hole that is scored, in pixels."""

Scores = dict[str, float | None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="+", help="pair, or an order and a number: nearest-3")
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--only", default="", help="part of the names of the cases")
    parser.add_argument("--apart", action="store_true", help=HELP)
    options = parser.parse_args()
    path = HELD_OUT if options.held_out else DEVELOPMENT
    cases = read_pairs(path, options.apart, options.only)
    jobs = [(case, tuple(options.sets)) for case in cases]
    with get_context("spawn").Pool(2) as pool:
        rows = list(pool.imap(score_case, jobs))
    for number, name in enumerate(options.sets):
        print(name, json.dumps(average([row[number] for row in rows])))
        for case, row in zip(cases, rows, strict=True):
            print(f"  {case.name:32s} {json.dumps(row[number])}")


def read_pairs(path: Path, uses_apart: bool, name: str) -> list[Case]:
    """Read cases and keep the pair that each begins with; near and far are found, as for users."""
    cases = read_used_cases(path, uses_apart, name)
    return [replace(case, context=case.context[:2], near=None, far=None) for case in cases]


def average(rows: list[Scores]) -> Scores:
    """Average each score over the cases that have it."""
    known = {key: [row[key] for row in rows if row[key] is not None] for key in rows[0]}
    return {key: round(mean(values), 3) for key, values in known.items()}


def score_case(job: tuple[Case, tuple[str, ...]]) -> list[Scores]:
    """Score a case with each set of photographs; the pair comes first and gives the hole."""
    case, sets = job
    torch.set_num_threads(1)
    hole = find_hole(case)
    return [score_set(add_set(case, name), hole) for name in sets]


def add_set(case: Case, name: str) -> Case:
    """Add the further photographs of a set to the pair of a case."""
    if name == "pair":
        return case
    order, count = name.split("-")
    row = {
        "scene": case.scene.name,
        "context": list(case.context),
        "target": case.target,
        "neighbours": case.neighbours,
    }
    return replace(case, context=tuple(add_photographs(row, order, int(count))["context"]))


def reconstruct(case: Case) -> tuple[Gaussians, list[View], list[View], float]:
    """Reconstruct a case; return its scene, photographs, target and neighbours, and seconds."""
    models = RunConfig().load_models(())
    views = sort_by_frame(load(case, case.context))
    shown = load(case, (case.target, *case.neighbours))
    start = time.perf_counter()
    # As for users, photographs near the target count most.
    context = reconstruct_context(models.reconstructor, views, favored=[shown[0].camera])
    seconds = time.perf_counter() - start
    camera = context.views[0].camera
    given = normalize_exposures(views, context.exposure_gains)
    # All are seen in the depth range that the scene was reconstructed in.
    given, shown = (set_depth_range(group, camera.near, camera.far) for group in (given, shown))
    return context.source.gaussians, given, shown, seconds


def load(case: Case, frames: tuple[int, ...]) -> list[View]:
    """Load photographs with their frame numbers, by which they are sorted."""
    return load_task_views(make_case_task(case), frames, RunConfig())


def find_hole(case: Case) -> Bool[Tensor, "h w"]:
    """Find the pixels of the target that the pair leaves open."""
    scene, _, shown, _ = reconstruct(case)
    renderer = RunConfig().load_models(()).renderer
    return renderer.render(scene, shown[0].camera).alpha < COVERED


def score_set(case: Case, hole: Bool[Tensor, "h w"]) -> Scores:
    """Reconstruct and complete a case; return PSNR in dB, and seconds of the reconstruction."""
    scene, given, shown, seconds = reconstruct(case)
    target, *neighbours = shown
    models = RunConfig().load_models(())
    completer = models.make_completer()
    done = completer.advance(completer.begin(given, scene), target.camera).scene

    def score(gaussians: Gaussians, view: View, mask: Bool[Tensor, "h w"] | None = None) -> float:
        image = models.renderer.render(gaussians, view.camera).image
        valid = view.valid_mask if mask is None else mask & view.valid_mask
        value = compute_masked_psnr(image, view.image, valid)
        assert value is not None
        return value

    return {
        "target": score(done, target),
        "hole": score(done, target, hole) if int(hole.sum()) > MIN_HOLE else None,
        "outside": score(done, target, ~hole),
        "beside": mean(score(done, view) for view in neighbours),
        "photographs": mean(score(scene, view) for view in given),
        "seconds": seconds,
    }


if __name__ == "__main__":
    main()
