"""Whether a given scene was lifted from pixels, or trained.

Models that make a Gaussian for each pixel make it as large as its pixel: its middle scale is
proportional to its distance from the camera. So the centre of the camera is where the ratio of the
two varies least. Trained splats have no such centre, and are opaque beyond what was photographed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.system.errors import InputError
from gscompleter.types import Gaussians

MAX_SPREAD = 0.4
"""Largest spread of the ratio in a pixel-aligned splat, relative to that of the scales alone.

It was 0.02 to 0.24 in 32 contexts of two photographs, and 0.59 to 1.00 in trained splats.
"""
MAX_SAMPLES = 8000
"""Gaussians that are compared."""
MIN_COMPARED_OPACITY = 0.3
"""Least opacity of a Gaussian that is compared."""
MIN_DECIDING = 8
"""Fewest Gaussians that decide: three coordinates and a ratio can be chosen so that they fit the
sizes of about four, whatever these are."""
SEARCH_SEED = 0
NUM_STARTS = 600
"""Random centres that are tried first, in a cube around the splat's middle."""
START_REACH = 3.0
"""Half of the side of that cube, in radii."""
STEP_DEVIATIONS = (0.6, 0.3, 0.15, 0.08, 0.04, 0.02, 0.01)
"""Standard deviations of the steps of each further round, in radii."""
NUM_KEPT = 8
"""Centres that are kept from round to round."""
NUM_RANDOM_STEPS = 40
"""Random steps from each of them."""
CORE_QUANTILES = (0.03, 0.97)
"""Quantiles of the coordinates between which the core of a splat lies."""
QUANTILE_SAMPLE = 100_000
"""Gaussians, evenly taken from those of a splat, that are enough to find quantiles."""


@dataclass(frozen=True)
class Core:
    """The middle of a splat and its size, without what lies far outside."""

    center: Float[Tensor, "3"]
    half: Float[Tensor, "3"]
    """Half of its size along each axis, in scene units."""

    @property
    def radius(self) -> float:
        """Half of the diagonal, in scene units."""
        return max(self.half.norm().item(), 1e-12)


def measure_core(means: Float[Tensor, "n 3"]) -> Core:
    """Measure the core of a splat; raise InputError for one without Gaussians."""
    if not len(means):
        raise InputError("A splat without Gaussians has no size; name another one.")
    sample = means[:: max(1, len(means) // QUANTILE_SAMPLE)]
    low, high = torch.quantile(sample, means.new_tensor(CORE_QUANTILES), 0)
    return Core((low + high) / 2, (high - low) / 2)


def is_lifted(scene: Gaussians) -> bool:
    """Return True if a scene was lifted from pixels, and False for a trained splat."""
    return find_pixel_center(scene) is not None


def find_pixel_center(scene: Gaussians) -> Float[Tensor, "3"] | None:
    """Find the centre of the camera of a pixel-aligned splat; None for other splats."""
    generator = torch.Generator().manual_seed(SEARCH_SEED)
    opaque = torch.nonzero(scene.opacities > MIN_COMPARED_OPACITY)[:, 0].cpu()
    if len(opaque) < MIN_DECIDING:
        return None
    chosen = opaque[torch.randperm(len(opaque), generator=generator)[:MAX_SAMPLES]]
    chosen = chosen.to(scene.means.device)
    means = scene.means.detach()[chosen].cpu()
    # The middle one of the three scales: the largest also tells how a surface is inclined.
    sizes = scene.scales.detach()[chosen].cpu().sort(dim=1).values[:, 1].clamp_min(1e-30).log()
    spread_alone = measure_spread(sizes[None])[0].item()
    if spread_alone == 0:
        return None
    core = measure_core(means)
    # Relative to the middle: differences of squares would cancel far from the origin.
    offsets = means - core.center

    def measure(centers: Float[Tensor, "c 3"]) -> Float[Tensor, "c"]:
        # In place: matrices of 20 MB that are made anew cost as much as what is computed.
        logs = torch.cdist(centers, offsets).clamp_min_(1e-3 * core.radius).log_()
        return measure_spread(torch.sub(sizes, logs, out=logs))

    starts = 2 * torch.rand((NUM_STARTS, 3), generator=generator) - 1
    centers = START_REACH * core.radius * starts
    for step in STEP_DEVIATIONS:
        best = centers[measure(centers).topk(NUM_KEPT, largest=False).indices]
        steps = torch.randn((NUM_KEPT, NUM_RANDOM_STEPS, 3), generator=generator)
        around = best[:, None] + step * core.radius * steps
        centers = torch.cat([best, around.reshape(-1, 3)])
    spreads = measure(centers)
    if spreads.min().item() > MAX_SPREAD * spread_alone or math.isnan(spreads.min().item()):
        return None
    return (core.center + centers[spreads.argmin()]).to(scene.means)


def measure_spread(values: Float[Tensor, "c n"]) -> Float[Tensor, "c"]:
    """Measure the mean absolute deviation of each row, on the CPU, from its lower median."""
    middle = (values.shape[1] - 1) // 2
    # What torch.median finds, in a fifth of its time. A NaN in a row stays one in the mean.
    medians = np.partition(values.numpy(), middle, axis=1)[:, middle]
    return (values - torch.from_numpy(medians)[:, None]).abs_().mean(dim=1)
