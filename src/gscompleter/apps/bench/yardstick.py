"""A fixed workload, to compare times of different machines and busy hours."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from gscompleter.render import Renderer
from gscompleter.types import Camera, Gaussians, make_observed, merge, sh_from_rgb

SIDE = 256
"""Side of the image in pixels."""
SHIFTS = (-0.2, 0.2, 0.4)
"""Camera positions in metres to the right; each camera adds one Gaussian per pixel."""
RUNS = 5
"""Number of runs of which the median is taken."""

GRADIENT_FIELDS = ("means", "quats", "scales", "opacities", "sh")
"""Fields that have gradients."""

T = TypeVar("T")


@dataclass(frozen=True)
class Yardstick:
    """Rendering and gradients of 196,608 Gaussians in an image of 256 x 256."""

    renderer: Renderer
    gaussians: Gaussians
    camera: Camera

    @staticmethod
    def create(renderer: Renderer, device: str) -> Yardstick:
        """Create the yardstick on a device, and run it once to compile everything."""
        scene = merge([make_surface(make_yardstick_camera(shift)) for shift in SHIFTS])
        found = Yardstick(renderer, scene.to(device), make_yardstick_camera(SHIFTS[-1]).to(device))
        found.render()
        return found

    def render(self) -> tuple[Tensor, ...]:
        """Render one image and compute the gradients of its sum."""
        varied = {name: getattr(self.gaussians, name).clone() for name in GRADIENT_FIELDS}
        variables = [tensor.requires_grad_() for tensor in varied.values()]
        image = self.renderer.render(replace(self.gaussians, **varied), self.camera).image
        return torch.autograd.grad(image.sum(), variables)

    def measure_seconds(self) -> float:
        """Measure the median seconds of `RUNS` runs."""
        return statistics.median(measure_call(self.render) for _ in range(RUNS))

    def measure_beside(self, measure: Callable[[], T]) -> tuple[T, float]:
        """Run `measure`, and return the mean yardstick of just before and just after."""
        before = self.measure_seconds()
        found = measure()
        return found, (before + self.measure_seconds()) / 2


def measure_call(work: Callable[[], object]) -> float:
    """Measure the seconds of a call, including its work on a GPU."""
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def make_yardstick_camera(shift: float) -> Camera:
    """Make a camera along z, `shift` metres to the right."""
    K = torch.tensor([[1.2 * SIDE, 0, SIDE / 2], [0, 1.2 * SIDE, SIDE / 2], [0, 0, 1]])
    c2w = torch.eye(4)
    c2w[0, 3] = shift
    return Camera(c2w, K, SIDE, SIDE, near=1.0, far=8.0)


def make_surface(camera: Camera) -> Gaussians:
    """Make one Gaussian per pixel of a camera, on a wavy surface 3 m away."""
    x = torch.linspace(0, 12, SIDE)
    depth = 3 + 0.5 * torch.sin(x)[None] * torch.cos(x)[:, None]
    n = SIDE * SIDE
    colours = torch.rand(n, 3, generator=torch.Generator().manual_seed(0))
    return make_observed(
        (camera.center + depth[..., None] * camera.z_rays()).reshape(-1, 3),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        (0.5 * depth / camera.K[0, 0]).reshape(-1, 1).repeat(1, 3),
        torch.full((n,), 0.9),
        sh_from_rgb(colours),
    )
