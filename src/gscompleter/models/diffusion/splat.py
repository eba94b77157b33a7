"""Forward splatting of a photograph into another camera; holes stay black."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def splat_forward(
    image: Float[Tensor, "h w c"], pixels: Float[Tensor, "h w 2"], size: tuple[int, int]
) -> Float[Tensor, "height width c"]:
    """Move each pixel of `image` to the nearest pixel of its position in a target of `size`.

    Pixels at the same position are averaged regardless of depth; pixels outside move to the border.
    `pixels` has (column, row), where 0 is the centre of the first.
    """
    h, w = size
    columns = pixels[..., 0].round().clamp(0, w - 1).long()
    rows = pixels[..., 1].round().clamp(0, h - 1).long()
    places = (rows * w + columns).flatten()
    sums = image.new_zeros(h * w, image.shape[2]).index_add_(0, places, image.flatten(0, 1))
    counts = torch.bincount(places, minlength=h * w)[:, None]
    return (sums / (counts + 1e-6)).unflatten(0, size)
