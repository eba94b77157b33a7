"""A photograph thrown into another camera, pixel by pixel, with holes left black."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def forward_splat(
    image: Float[Tensor, "h w c"], pixels: Float[Tensor, "h w 2"], size: tuple[int, int]
) -> Float[Tensor, "height width c"]:
    """Each pixel of `image` at the pixel nearest to where `pixels` (column, row) puts it.

    Several that meet are averaged, whatever their depths, and what lies outside goes to the border.

    Args:
        image: The photograph.
        pixels: Where each of its pixels lies in the other image; 0 is the centre of the first.
        size: Height and width of the other image.
    """
    h, w = size
    columns = pixels[..., 0].round().clamp(0, w - 1).long()
    rows = pixels[..., 1].round().clamp(0, h - 1).long()
    places = (rows * w + columns).flatten()
    sums = image.new_zeros(h * w, image.shape[2]).index_add_(0, places, image.flatten(0, 1))
    counts = torch.bincount(places, minlength=h * w)[:, None]
    return (sums / (counts + 1e-6)).unflatten(0, size)
