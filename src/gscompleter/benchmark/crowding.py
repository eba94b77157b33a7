"""Scenes of any number of Gaussians that still show what their photographs show."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from gscompleter.types import Gaussians

JITTER = 0.1
"""How far a copy lies from where it was, in standard deviations of the Gaussian."""


def crowded(scene: Gaussians, count: int, seed: int = 0) -> Gaussians:
    """`count` Gaussians that look about as `scene` does: its Gaussians in turn, each moved a
    little, and so much fainter that its copies together cover what it covered alone.

    Fewer than there are, they are a random choice.
    """
    rng = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(scene), generator=rng)
    rows = order.repeat(math.ceil(count / len(scene)))[:count]
    copies = torch.bincount(rows, minlength=len(scene))[rows].to(scene.means)
    crowd = scene[rows.to(scene.means.device)]
    offsets = JITTER * torch.randn(count, 3, generator=rng).to(crowd.means)
    means = crowd.means + offsets * crowd.scales.amin(dim=1, keepdim=True)
    fainter = -torch.expm1(torch.log1p(-crowd.opacities) / copies)
    return replace(crowd, means=means, opacities=fainter, encoded=None)
