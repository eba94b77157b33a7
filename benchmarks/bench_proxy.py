"""Time to freeze a LOD proxy instead of the whole scene, and their similarity, in one run.

    python benchmarks/bench_proxy.py [--count 2000000]

The scene is that of `bench_render.py`, copied until there are `count` Gaussians. The alternatives
are the whole scene and a subset as large as the proxy with enlarged Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import tyro

from bench_render import make_pixel_gaussians, measure_median_seconds
from completions.cases import multiply_gaussians
from gscompleter import Gaussians, load_renderer, merge
from gscompleter.data.demo_scene import move_right
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.render.lod import simplify_scene, thin_gaussians
from gscompleter.splats.morton import argsort_nearby
from gscompleter.types import Camera


def main(count: int = 2_000_000, size: int = 256, cameras: int = 4) -> None:
    """Print the ratios.

    Args:
        count: Gaussians of the scene.
        size: Side of the images.
        cameras: Number of cameras.
    """
    scene = multiply_gaussians(
        merge([make_pixel_gaussians(size, x)[0] for x in (-0.2, 0.2)]), count
    )
    scene = scene[argsort_nearby(scene)]
    start = make_pixel_gaussians(size, -0.3)[1].camera
    viewpoints = [
        move_right(start, 0.6 * number / max(cameras - 1, 1)) for number in range(cameras)
    ]
    made = measure_median_seconds(lambda: simplify_scene(scene, viewpoints), runs=3)
    proxy = simplify_scene(scene, viewpoints).rendered
    whole, ours, fewer = (
        measure_median_seconds(lambda part=part: freeze_at_all(part, viewpoints), runs=3)
        for part in (scene, proxy, thin_gaussians(scene, len(proxy)))
    )
    print(f"{count:,} Gaussians, {len(proxy):,} in the proxy, {cameras} views of {size} px:")
    print(f"  {whole / ours:6.1f} x   all of them frozen / the proxy")
    print(f"  {whole / (ours + made):6.1f} x   the same, making it included ({1e3 * made:.0f} ms)")
    print(f"  {fewer / ours:6.1f} x   as many of them, enlarged / the proxy")
    print(f"  {compute_likeness(proxy, scene, viewpoints):6.1f} dB  the proxy to all of them")
    print(
        f"  {compute_likeness(thin_gaussians(scene, len(proxy)), scene, viewpoints):6.1f} dB  as "
        "many of them"
    )


def freeze_at_all(scene: Gaussians, cameras: Sequence[Camera]) -> None:
    for camera in cameras:
        load_renderer("cpu").freeze(scene, camera)


def compute_likeness(scene: Gaussians, whole: Gaussians, cameras: Sequence[Camera]) -> float:
    """Compute the mean PSNR between renders of two scenes, in dB."""
    draw = load_renderer("cpu").render
    pairs = ((draw(scene, camera).image, draw(whole, camera).image) for camera in cameras)
    return torch.tensor([psnr(*pair) for pair in pairs]).mean().item()


if __name__ == "__main__":
    tyro.cli(main)
