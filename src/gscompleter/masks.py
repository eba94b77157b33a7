"""Operations on image masks."""

from __future__ import annotations

from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import max_pool2d


def dilate(mask: Bool[Tensor, "h w"], radius: int) -> Bool[Tensor, "h w"]:
    """Dilate `mask` by a square of 2 radius + 1 pixels."""
    side, grown = 2 * radius + 1, mask[None, None].float()
    for size, padding in (((1, side), (0, radius)), ((side, 1), (radius, 0))):
        grown = max_pool2d(grown, size, stride=1, padding=padding)
    return grown[0, 0] > 0


def is_enclosed(mask: Bool[Tensor, "h w"]) -> bool:
    """Return True if `mask` is not empty and does not touch the border of the image."""
    return bool(mask.any()) and int(mask.sum()) == int(mask[1:-1, 1:-1].sum())
