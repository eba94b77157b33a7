"""A subset of Gaussians that renders almost the same in small images."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.types import Gaussians

MAX_GAUSSIANS = 400_000
"""Largest number kept: several per pixel of a small image."""
SAMPLE_SIZE = 100_000
"""Gaussians from which the distribution of sizes is estimated."""


def thin_gaussians(scene: Gaussians, max_gaussians: int = MAX_GAUSSIANS) -> Gaussians:
    """Reduce a scene to about `max_gaussians` Gaussians, enlarged to cover the same area.

    Gaussians are kept with a probability proportional to their size. The choice depends on their
    order
    alone, and neighbours in the file are thinned evenly.
    """
    if len(scene) <= max_gaussians:
        return scene
    rows, growth = choose_thinned_rows(scene, max_gaussians)
    chosen = replace(scene, encoded=None)[rows]
    return replace(chosen, scales=chosen.scales * growth[:, None])


def choose_thinned_rows(
    scene: Gaussians, max_gaussians: int = MAX_GAUSSIANS
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Select the rows to keep, and the factor by which their sizes grow."""
    if len(scene) <= max_gaussians:
        return torch.arange(len(scene), device=scene.means.device), torch.ones_like(scene.opacities)
    chance = compute_keep_probabilities(scene, max_gaussians)
    place = chance.double().cumsum(0).floor()
    stays = place > torch.nn.functional.pad(place[:-1], (1, 0))
    rows = torch.nonzero(stays)[:, 0]
    return rows, chance[rows].rsqrt()


def compute_keep_probabilities(scene: Gaussians, max_gaussians: int) -> Float[Tensor, "n"]:
    """Compute keep probabilities proportional to projected size; their sum is at most the limit.

    The largest 1 % is clamped: floaters and sky are large, few, and useless for matching.
    """
    cross_section = scene.scales.prod(dim=1) / scene.scales.amin(dim=1).clamp_min(1e-30)
    size = (cross_section * scene.opacities).sqrt()
    sample = size[:: max(1, len(size) // SAMPLE_SIZE)]
    size = size.clamp(max=sample.quantile(0.99)).clamp_min(1e-30)
    return (max_gaussians * (size / size.sum(dtype=torch.float64))).clamp(max=1).to(size)
