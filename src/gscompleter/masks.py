"""Masks over the pixels of an image."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor


def dilate(mask: Bool[Tensor, "h w"], radius: int) -> Bool[Tensor, "h w"]:
    """`mask` grown by `radius` pixels on every side (max-pool of 2 radius + 1)."""
    pooled = torch.nn.functional.max_pool2d(
        mask[None, None].float(), 2 * radius + 1, stride=1, padding=radius
    )
    return pooled[0, 0] > 0
