"""Error of depth at held-out pixels, and PSNR at the target, with half of the depth given.

    python benchmarks/bench_given_depth.py --data benchmarks/development.json --block 16

Each context photograph of the cases whose scene has depth gets a random half of the blocks of its
depth map; the other half, and the depth of the target, score. `--drive` scores a synthetic street
with scan lines of a laser instead, of which a random half is given.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

from apart import HELP, read_used_cases
from gscompleter import GSCompleter, View
from gscompleter.data.given_depth import drop_edges, drop_hidden
from gscompleter.evaluation.metrics.geometry import compare_depths
from gscompleter.evaluation.metrics.image import compute_masked_psnr

SCAN_ROWS, SCAN_COLUMNS = 6, 2
"""Rows and columns of pixels between the points of the synthetic laser."""
Scene = tuple[str, list[View], View, bool]


def read_scenes(path: Path, uses_apart: bool) -> Iterator[Scene]:
    """Yield name, context and target of the cases whose photographs have depth maps."""
    for case in read_used_cases(path, uses_apart):
        views, (target,) = case.load(case.context), case.load((case.target,))
        if target.depth is not None:
            yield case.name, views, target, True


def make_drive() -> Iterator[Scene]:
    """Yield a street with a laser, whose photographs are taken two metres apart."""
    sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
    from scenes import camera_at, open_street

    views = [open_street(camera_at(0.2 * z, z=z, size=256)) for z in (0.0, 2.0, 4.0)]
    scan = torch.zeros(256, 256)
    scan[::SCAN_ROWS, ::SCAN_COLUMNS] = 1
    views = [replace(v, depth=(v.depth.nan_to_num(posinf=0) * scan)) for v in views]
    yield "street", views[:2], views[2], False


def choose_blocks(view: View, size: int, seed: int) -> torch.Tensor:
    """Choose a random half of the blocks of a photograph."""
    h, w = view.image.shape[:2]
    rng = torch.Generator().manual_seed(seed)
    blocks = torch.rand(-(-h // size), -(-w // size), generator=rng) < 0.5
    return blocks.repeat_interleave(size, 0).repeat_interleave(size, 1)[:h, :w]


def give_blocks(view: View, blocks: torch.Tensor, is_dense: bool) -> View:
    """Give the depth in some blocks, as a completion does, and score with that of the others."""
    assert view.depth is not None
    given = (drop_edges if is_dense else drop_hidden)(view.depth * blocks)
    return replace(view, depth=view.depth * ~blocks, given_depth=given)


def measure(views: list[View], target: View) -> list[float]:
    """Measure AbsRel at the depths of the context and of the target, and PSNR at the target."""
    completer = GSCompleter()
    state = completer.begin(views)
    renders = [completer.renderer.render(state.scene, v.camera) for v in (*views, target)]
    errors = []
    for view, render in zip((*views, target), renders, strict=True):
        assert view.depth is not None
        errors.append(compare_depths(render.depth, view.depth, render.depth_map().valid).abs_rel)
    done = completer.advance(state, target.camera)
    after = completer.renderer.render(done.scene, target.camera).image
    return [
        fmean(e for e in errors[:-1] if e is not None),
        errors[-1] or 0.0,
        compute_masked_psnr(renders[-1].image, target.image, renders[-1].depth_map().valid) or 0.0,
        compute_masked_psnr(after, target.image, target.valid_mask) or 0.0,
    ]


def main() -> None:
    """Print a row per case: without given depth -> with half of it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path)
    parser.add_argument("--block", type=int, default=16, help="side of a block, in pixels")
    parser.add_argument("--drive", action="store_true")
    parser.add_argument("--apart", action="store_true", help=HELP)
    options = parser.parse_args()
    print(f"{'':24s} AbsRel held out  AbsRel target  PSNR seen  PSNR completed")
    for name, views, target, is_dense in (
        make_drive() if options.drive else read_scenes(options.data, options.apart)
    ):
        chosen = [choose_blocks(v, options.block, i) for i, v in enumerate(views)]
        given = [give_blocks(v, b, is_dense) for v, b in zip(views, chosen, strict=True)]
        rows = [
            measure([replace(v, given_depth=None) for v in given], target),
            measure(given, target),
        ]
        cells = (f"{a:.3f} -> {b:.3f}" for a, b in zip(*rows, strict=True))
        print(f"{name:24s} {'   '.join(cells)}", flush=True)


if __name__ == "__main__":
    main()
