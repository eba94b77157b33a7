"""Bilinear resizing of feature maps."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def resize_bilinear(x: Float[Tensor, "n c h w"], size: tuple[int, int]) -> Float[Tensor, "n c p q"]:
    """Resize a map bilinearly; the centres of the corner pixels stay in place."""
    return F.interpolate(x, size=size, mode="bilinear", align_corners=True)


def enlarge(x: Float[Tensor, "n c h w"], factor: int) -> Float[Tensor, "n c p q"]:
    """Enlarge a map by `factor` in both directions."""
    return resize_bilinear(x, (factor * x.shape[2], factor * x.shape[3]))
