"""Smooth continuation of values known in a part of an image."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, interpolate, pad


def fill_smoothly(
    values: Float[Tensor, "h w"], known: Bool[Tensor, "h w"], num_relaxations: int = 64
) -> Float[Tensor, "h w"]:
    """`values` where `known`, continued smoothly elsewhere.

    A pyramid gives every unknown pixel the mean of what is known around it, from the finest level
    that knows anything; relaxation then smooths the unknown part towards the membrane that is
    clamped to what is known. Zero everywhere if nothing is known.
    """
    weights = known.to(values.dtype)[None, None]
    filled = push_pull(values[None, None] * weights, weights)
    kernel = values.new_tensor([[0, 1, 0], [1, 0, 1], [0, 1, 0]])[None, None] / 4
    for _ in range(num_relaxations):
        around = conv2d(pad(filled, (1, 1, 1, 1), mode="replicate"), kernel)
        filled = torch.where(known, values, around)
    return filled[0, 0]


def push_pull(
    weighted: Float[Tensor, "1 1 h w"], weights: Float[Tensor, "1 1 h w"]
) -> Float[Tensor, "1 1 h w"]:
    """Weighted means, and where a pixel has no weight those of the next coarser level."""
    mean = weighted / weights.clamp_min(1e-12)
    if weights.shape[-2:].numel() == 1 or bool((weights > 0).all()):
        return mean
    coarse = push_pull(
        avg_pool2d(weighted, 2, ceil_mode=True), avg_pool2d(weights, 2, ceil_mode=True)
    )
    upsampled = interpolate(coarse, size=weights.shape[-2:], mode="bilinear", align_corners=False)
    return torch.where(weights > 0, mean, upsampled)
