"""Scenes of any number of Gaussians with the same appearance."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from gscompleter.types import Gaussians

JITTER = 0.1
"""Offset of a copy, in standard deviations of its Gaussian."""


def multiply_gaussians(scene: Gaussians, count: int, seed: int = 0) -> Gaussians:
    """Repeat Gaussians until there are `count`, with offsets and reduced opacities.

    All copies of a Gaussian together have its opacity. If `count` is smaller than the scene, a
    random subset is returned.
    """
    rng = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(scene), generator=rng)
    rows = order.repeat(math.ceil(count / len(scene)))[:count]
    copies = torch.bincount(rows, minlength=len(scene))[rows].to(scene.means)
    repeats = scene[rows.to(scene.means.device)]
    offsets = JITTER * torch.randn(count, 3, generator=rng).to(repeats.means)
    means = repeats.means + offsets * repeats.scales.amin(dim=1, keepdim=True)
    fainter = -torch.expm1(torch.log1p(-repeats.opacities) / copies)
    return replace(repeats, means=means, opacities=fainter, encoded=None)
