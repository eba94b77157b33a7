"""Masks over the pixels of an image."""

from __future__ import annotations

from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import max_pool2d


def dilate(mask: Bool[Tensor, "h w"], radius: int) -> Bool[Tensor, "h w"]:
    """`mask` grown by `radius` pixels on every side (max-pool of 2 radius + 1, by rows and then by
    columns)."""
    side, grown = 2 * radius + 1, mask[None, None].float()
    for size, padding in (((1, side), (0, radius)), ((side, 1), (radius, 0))):
        grown = max_pool2d(grown, size, stride=1, padding=padding)
    return grown[0, 0] > 0


def is_enclosed(mask: Bool[Tensor, "h w"]) -> bool:
    """Whether the image holds `mask` whole: there is some of it, and none at the edge."""
    return bool(mask.any()) and int(mask.sum()) == int(mask[1:-1, 1:-1].sum())
