"""A subset of Gaussians that renders almost the same in small images."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.types import Gaussians

MAX_GAUSSIANS = 400_000
"""Largest number kept: several per pixel of a small image."""
SAMPLE = 100_000
"""Gaussians from which the distribution of sizes is estimated."""


def thinned(scene: Gaussians, most: int = MAX_GAUSSIANS) -> Gaussians:
    """Reduce a scene to about `max_gaussians` Gaussians, enlarged to cover the same area.

    Gaussians are kept with a probability proportional to their size. The choice depends on their
    order
    alone, and neighbours in the file are thinned evenly.
    """
    if len(scene) <= most:
        return scene
    rows, growth = thinning(scene, most)
    chosen = replace(scene, encoded=None)[rows]
    return replace(chosen, scales=chosen.scales * growth[:, None])


def thinning(
    scene: Gaussians, most: int = MAX_GAUSSIANS
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Select the rows to keep, and the factor by which their sizes grow."""
    if len(scene) <= most:
        return torch.arange(len(scene), device=scene.means.device), torch.ones_like(scene.opacities)
    chance = chances(scene, most)
    place = chance.double().cumsum(0).floor()
    stays = place > torch.nn.functional.pad(place[:-1], (1, 0))
    rows = torch.nonzero(stays)[:, 0]
    return rows, chance[rows].rsqrt()


def chances(scene: Gaussians, most: int) -> Float[Tensor, "n"]:
    """Compute keep probabilities proportional to projected size; their sum is at most the limit.

    The largest 1 % is clamped: floaters and sky are large, few, and useless for matching.
    """
    cross_section = scene.scales.prod(dim=1) / scene.scales.amin(dim=1).clamp_min(1e-30)
    size = (cross_section * scene.opacities).sqrt()
    sample = size[:: max(1, len(size) // SAMPLE)]
    size = size.clamp(max=sample.quantile(0.99)).clamp_min(1e-30)
    return (most * (size / size.sum(dtype=torch.float64))).clamp(max=1).to(size)
