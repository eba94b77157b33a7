"""Fewer Gaussians that look about the same in small images."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.types import Gaussians

MAX_GAUSSIANS = 400_000
"""Several for each pixel of a small image; more say nothing new there."""
SAMPLE = 100_000
"""Gaussians by which the sizes of all are known."""


def thinned(scene: Gaussians, most: int = MAX_GAUSSIANS) -> Gaussians:
    """`scene`, or where it has more than `most` Gaussians, about as many, enlarged.

    A Gaussian stays with a chance in proportion to its size, and one that stays stands for others
    like it: its cross-section grows by as much as they are fewer. Which ones stay follows from
    their order alone, and neighbours in a file are thinned evenly.
    """
    if len(scene) <= most:
        return scene
    rows, growth = thinning(scene, most)
    chosen = replace(scene, encoded=None)[rows]
    return replace(chosen, scales=chosen.scales * growth[:, None])


def thinning(
    scene: Gaussians, most: int = MAX_GAUSSIANS
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Indices of the Gaussians that stay, and the factor by which each one's size grows."""
    if len(scene) <= most:
        return torch.arange(len(scene), device=scene.means.device), torch.ones_like(scene.opacities)
    chance = chances(scene, most)
    place = chance.double().cumsum(0).floor()
    stays = place > torch.nn.functional.pad(place[:-1], (1, 0))
    rows = torch.nonzero(stays)[:, 0]
    return rows, chance[rows].rsqrt()


def chances(scene: Gaussians, most: int) -> Float[Tensor, "n"]:
    """In proportion to what each Gaussian covers to the eye, as a length; `most` in sum or less.

    The largest hundredth count alike: floaters and the sky are large, few, and not what
    photographs are recognised by.
    """
    cross_section = scene.scales.prod(dim=1) / scene.scales.amin(dim=1).clamp_min(1e-30)
    size = (cross_section * scene.opacities).sqrt()
    sample = size[:: max(1, len(size) // SAMPLE)]
    size = size.clamp(max=sample.quantile(0.99)).clamp_min(1e-30)
    return (most * (size / size.sum(dtype=torch.float64))).clamp(max=1).to(size)
