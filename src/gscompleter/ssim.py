"""Structural similarity as a differentiable map."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

RADIUS, SIGMA = 5, 1.5
"""Radius and standard deviation of the Gaussian window, in pixels."""


def ssim_map(
    image: Float[Tensor, "h w 3"], other: Float[Tensor, "h w 3"]
) -> Float[Tensor, "1 3 h w"]:
    """Compute structural similarity (Wang et al. 2004) around each pixel, padding with black."""
    offsets = torch.arange(2 * RADIUS + 1, dtype=image.dtype, device=image.device) - RADIUS
    line = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    line = (line / line.sum()).repeat(3, 1)

    def blur(values: Float[Tensor, "h w 3"]) -> Tensor:
        planes = values.permute(2, 0, 1)[None]
        rows = conv2d(planes, line[:, None, None, :], padding=(0, RADIUS), groups=3)
        return conv2d(rows, line[:, None, :, None], padding=(RADIUS, 0), groups=3)

    a, b = blur(image), blur(other)
    aa, bb, ab = blur(image**2) - a**2, blur(other**2) - b**2, blur(image * other) - a * b
    c1, c2 = 0.01**2, 0.03**2
    return (2 * a * b + c1) * (2 * ab + c2) / ((a**2 + b**2 + c1) * (aa + bb + c2))
