"""The camera of a pixel-aligned splat, found from the sizes of its Gaussians.

Models that make a Gaussian for each pixel make it as large as its pixel: its middle scale is
proportional to its distance from the camera. So the centre of the camera is where the ratio of the
two varies least. Trained splats have no such centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.numerics.geometry import look_along
from gscompleter.planning.candidates import move_camera
from gscompleter.types import Camera, Gaussians

MAX_SPREAD = 0.4
"""Largest spread of the ratio in a pixel-aligned splat, relative to that of the scales alone.

It was 0.02 to 0.24 in 32 contexts of two photographs, and 0.59 to 1.00 in trained splats.
"""
MAX_SAMPLES = 8000
"""Gaussians that are compared."""
MIN_OPACITY = 0.3
"""Least opacity of a Gaussian that is compared."""
SEED = 0
NUM_STARTS = 600
"""Random centres that are tried first, within `REACH` radii of the middle of the splat."""
REACH = 3.0
STEPS = (0.6, 0.3, 0.15, 0.08, 0.04, 0.02, 0.01)
"""Standard deviations of the steps of each further round, in radii."""
NUM_KEPT = 8
"""Centres that are kept from round to round."""
NUM_STEPS = 40
"""Random steps from each of them."""
INNER = 0.93
"""Share of the directions, along each axis of the image, that the camera shows."""
MOVES = (
    (0.08, 0.0, 0.0),
    (-0.08, 0.0, 0.0),
    (0.0, 0.05, 0.0),
    (0.0, -0.05, 0.0),
    (0.0, 0.0, 0.12),
    (0.05, 0.0, 0.1),
    (-0.05, 0.0, 0.1),
)
"""Moves of the camera that is found: right, down and forward, relative to the depth of its view."""
CORE = (0.03, 0.97)
"""Quantiles of the coordinates between which the core of a splat lies."""


@dataclass(frozen=True)
class Core:
    """The middle of a splat and its size, without what lies far outside."""

    center: Float[Tensor, "3"]
    radius: float
    """Half of the diagonal, in scene units."""


def measure_core(means: Float[Tensor, "n 3"]) -> Core:
    """Measure the core of a splat."""
    low, high = torch.quantile(means[:: max(1, len(means) // 100_000)], means.new_tensor(CORE), 0)
    return Core((low + high) / 2, max((high - low).norm().item() / 2, 1e-12))


def find_pixel_camera(scene: Gaussians, up: Float[Tensor, "3"], side: int) -> Camera | None:
    """Find the camera of a pixel-aligned splat, with a square image; None for other splats.

    `up` is the upward direction; `side` the width and height of the image, in pixels.
    """
    center = find_pixel_center(scene)
    if center is None:
        return None
    rays = normalize(scene.means - center, dim=1)
    forward = normalize(rays.mean(dim=0), dim=0)
    camera = Camera(torch.eye(4).to(rays), torch.eye(3).to(rays), side, side)
    c2w = camera.c2w.clone()
    c2w[:3, 3] = center
    posed = look_along(Camera(c2w, make_intrinsics(side, 1.0).to(rays), side, side), forward, up)

    # The field of view holds most directions: of several photographs it is that of all together.
    x, y, z = ((scene.means - center) @ posed.c2w[:3, :3]).unbind(1)
    ahead = z > 0
    halves = torch.stack(
        [(x / z)[ahead].abs().quantile(INNER), (y / z)[ahead].abs().quantile(INNER)]
    )
    return Camera(posed.c2w, make_intrinsics(side, halves.max().item()).to(rays), side, side)


def move_beside(camera: Camera, depth: float) -> list[Camera]:
    """Return a camera and small moves of it, relative to a z-depth in scene units."""
    no_turn = torch.eye(3).to(camera.c2w)
    axes = camera.c2w[:3, :3].T
    shifts = [depth * torch.tensor(move).to(axes) @ axes for move in MOVES]
    return [camera, *(move_camera(camera, no_turn, shift) for shift in shifts)]


def make_intrinsics(side: int, half: float) -> Float[Tensor, "3 3"]:
    """Make the intrinsics of a square image whose border is `half` aside at a depth of 1."""
    focal = side / 2 / half
    return torch.tensor([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])


def find_pixel_center(scene: Gaussians) -> Float[Tensor, "3"] | None:
    """Find the centre of the camera of a pixel-aligned splat; None for other splats."""
    generator = torch.Generator().manual_seed(SEED)
    opaque = torch.nonzero(scene.opacities > MIN_OPACITY)[:, 0].cpu()
    if len(opaque) < NUM_KEPT:
        return None
    chosen = opaque[torch.randperm(len(opaque), generator=generator)[:MAX_SAMPLES]]
    means = scene.means[chosen].cpu()
    # The middle one of the three scales: the largest also tells how a surface is inclined.
    sizes = scene.scales[chosen].cpu().sort(dim=1).values[:, 1].clamp_min(1e-30).log()
    spread_alone = measure_spread(sizes[None])[0].item()
    if spread_alone == 0:
        return None
    core = measure_core(means)

    def measure(centers: Float[Tensor, "c 3"]) -> Float[Tensor, "c"]:
        distances = torch.cdist(centers, means).clamp_min(1e-3 * core.radius)
        return measure_spread(sizes - distances.log())

    starts = 2 * torch.rand((NUM_STARTS, 3), generator=generator) - 1
    centers = core.center + REACH * core.radius * starts
    for step in STEPS:
        best = centers[measure(centers).topk(NUM_KEPT, largest=False).indices]
        steps = torch.randn((NUM_KEPT, NUM_STEPS, 3), generator=generator)
        around = best[:, None] + step * core.radius * steps
        centers = torch.cat([best, around.reshape(-1, 3)])
    spreads = measure(centers)
    if spreads.min().item() > MAX_SPREAD * spread_alone or math.isnan(spreads.min().item()):
        return None
    return centers[spreads.argmin()].to(scene.means)


def measure_spread(values: Float[Tensor, "c n"]) -> Float[Tensor, "c"]:
    """Measure the mean absolute deviation of each row from its median."""
    return (values - values.median(dim=1, keepdim=True).values).abs().mean(dim=1)
