"""Speed of the compiled renderer against alternatives, as ratios in one run.

    python benchmarks/bench_render.py [--size 256]

The context has one Gaussian per pixel of two cameras; a third camera adds the new ones.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import torch
import tyro

from gscompleter import Gaussians, View, load_renderer, merge
from gscompleter.data.demo_scene import get_motorcycle_cameras, move_right
from gscompleter.numerics.geometry import pad_camera
from gscompleter.types import make_observed, sh_from_rgb


def read_clock() -> float:
    """Return the clock in seconds, after all GPU work is done."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


def measure_median_seconds(
    function: Callable[[], object], runs: int = 7, warm: bool = True
) -> float:
    """Measure the median over `runs`, after a warm-up run unless `warm` is False."""
    if warm:
        function()
    seconds = []
    for _ in range(runs):
        start = read_clock()
        function()
        seconds.append(read_clock() - start)
    return statistics.median(seconds)


def make_pixel_gaussians(size: int, shift: float) -> tuple[Gaussians, View]:
    """Make one Gaussian per pixel of a camera moved by `shift` metres, on a surface 3 m away."""
    left, _ = get_motorcycle_cameras(741, 500)
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]])
    camera = move_right(replace(left, K=K, width=size, height=size, near=1.0, far=8.0), shift)
    x = torch.linspace(0, 12, size)
    depth = 3 + 0.5 * torch.sin(x)[None] * torch.cos(x)[:, None]
    n = size * size
    colours = torch.rand(n, 3, generator=torch.Generator().manual_seed(0))
    means = (camera.center + depth[..., None] * camera.z_rays()).reshape(-1, 3)
    gaussians = make_observed(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        (0.5 * depth / K[0, 0]).reshape(-1, 1).repeat(1, 3),
        torch.full((n,), 0.9),
        sh_from_rgb(colours),
    )
    return gaussians, View(colours.view(size, size, 3), camera)


def main(size: int = 256, reference_size: int = 48) -> None:
    """Print the table.

    Args:
        size: Side of the images of the compiled renderer.
        reference_size: Side of those for the slow reference renderer.
    """
    cpu, reference = load_renderer("cpu"), load_renderer("reference")

    def optimise(draw: Callable[[Gaussians], torch.Tensor], new: Gaussians) -> Callable[[], None]:
        def step() -> None:
            opacities = new.opacities.clone().requires_grad_()
            means = new.means.clone().requires_grad_()
            draw(replace(new, opacities=opacities, means=means)).sum().backward()

        return step

    small, view = make_pixel_gaussians(reference_size, 0.0)
    camera = pad_camera(view.camera, 0.0).padded
    ours = measure_median_seconds(optimise(lambda g: cpu.render(g, camera).image, small))
    theirs = measure_median_seconds(
        optimise(lambda g: reference.render(g, camera).image, small), runs=2
    )
    print(f"forward and backward, {len(small):,} Gaussians, {reference_size} px: reference / cpu")
    print(f"  {theirs / ours:10.1f} x   (cpu {1e3 * ours:.1f} ms)")

    context = merge([make_pixel_gaussians(size, x)[0] for x in (-0.2, 0.2)])
    new, view = make_pixel_gaussians(size, 0.4)
    frozen = cpu.freeze(context, view.camera)
    together = measure_median_seconds(
        optimise(lambda g: cpu.render(merge([context, g]), view.camera).image, new)
    )
    composite = measure_median_seconds(optimise(lambda g: frozen.composite(g).image, new))
    plan = frozen.vary_opacities(new)

    def planned() -> None:
        opacities = new.opacities.clone().requires_grad_()
        plan(opacities).image.sum().backward()

    opacity_only = measure_median_seconds(planned)
    print(f"a step of optimisation, {len(context):,} frozen and {len(new):,} new Gaussians:")
    print(f"  {together / composite:10.1f} x   all of them / composite of the frozen view")
    print(f"  {composite / opacity_only:10.1f} x   composite / plan, if only opacities move")
    print(f"  (composite {1e3 * composite:.1f} ms, plan {1e3 * opacity_only:.1f} ms)")


if __name__ == "__main__":
    tyro.cli(main)
