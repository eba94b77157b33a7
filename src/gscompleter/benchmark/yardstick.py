"""A fixed piece of work, so that times of several machines, and of busy hours, can be compared."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from gscompleter.render import Renderer
from gscompleter.types import Camera, Gaussians, merge, observed, sh_from_rgb

SIDE = 256
"""Of the image, in pixels."""
SHIFTS = (-0.2, 0.2, 0.4)
"""Where the cameras stand that have a Gaussian for each of their pixels, in metres to the right."""
RUNS = 5
"""Of which the median is taken."""

VARIED = ("means", "quats", "scales", "opacities", "sh")
"""What slopes are asked for."""

T = TypeVar("T")


@dataclass(frozen=True)
class Yardstick:
    """The renderer, forward and backward: 196,608 Gaussians in an image of 256 x 256."""

    renderer: Renderer
    gaussians: Gaussians
    camera: Camera

    @staticmethod
    def on(renderer: Renderer, device: str) -> Yardstick:
        """The yardstick on a device, drawn once, so that everything is compiled."""
        scene = merge([surface(camera_at(shift)) for shift in SHIFTS])
        found = Yardstick(renderer, scene.to(device), camera_at(SHIFTS[-1]).to(device))
        found.draw()
        return found

    def draw(self) -> tuple[Tensor, ...]:
        """One image, and the slope of its sum in everything that can vary."""
        varied = {name: getattr(self.gaussians, name).clone() for name in VARIED}
        variables = [tensor.requires_grad_() for tensor in varied.values()]
        image = self.renderer.render(replace(self.gaussians, **varied), self.camera).image
        return torch.autograd.grad(image.sum(), variables)

    def seconds(self) -> float:
        """Median of a few."""
        return statistics.median(timed(self.draw) for _ in range(RUNS))

    def beside(self, measure: Callable[[], T]) -> tuple[T, float]:
        """What `measure` gives, and the mean of the yardstick just before and just after."""
        before = self.seconds()
        found = measure()
        return found, (before + self.seconds()) / 2


def timed(work: Callable[[], object]) -> float:
    """Seconds that `work` takes, until a GPU has done its part too."""
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def camera_at(shift: float) -> Camera:
    """A camera that looks along z, `shift` metres to the right."""
    K = torch.tensor([[1.2 * SIDE, 0, SIDE / 2], [0, 1.2 * SIDE, SIDE / 2], [0, 0, 1]])
    c2w = torch.eye(4)
    c2w[0, 3] = shift
    return Camera(c2w, K, SIDE, SIDE, near=1.0, far=8.0)


def surface(camera: Camera) -> Gaussians:
    """A Gaussian for each pixel of a camera, on a wavy surface 3 m away."""
    x = torch.linspace(0, 12, SIDE)
    depth = 3 + 0.5 * torch.sin(x)[None] * torch.cos(x)[:, None]
    n = SIDE * SIDE
    colours = torch.rand(n, 3, generator=torch.Generator().manual_seed(0))
    return observed(
        (camera.center + depth[..., None] * camera.z_rays()).reshape(-1, 3),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        (0.5 * depth / camera.K[0, 0]).reshape(-1, 1).repeat(1, 3),
        torch.full((n,), 0.9),
        sh_from_rgb(colours),
    )
