"""Smooth filling: unknown values from known ones around them, by a pyramid of averages."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate


def push_pull(
    values: Float[Tensor, "h w c"], weight: Float[Tensor, "h w"]
) -> Float[Tensor, "h w c"]:
    """`values` where `weight` is 1; where it is 0, a smooth continuation of what surrounds it.

    Averages are pushed up a pyramid, and whatever a level lacks is pulled down from the coarser
    one (Gortler et al., The Lumigraph, 1996). Where no weight is positive at all the result is 0.
    """
    filled = _fill((values * weight[..., None]).permute(2, 0, 1)[None], weight[None, None])
    return filled[0].permute(1, 2, 0)


def _fill(
    weighted: Float[Tensor, "1 c h w"], weight: Float[Tensor, "1 1 h w"]
) -> Float[Tensor, "1 c h w"]:
    own = weighted / weight.clamp_min(1e-8)
    size = (weight.shape[2], weight.shape[3])
    if max(size) == 1 or bool((weight > 0).all()):
        return own
    coarse = _fill(
        avg_pool2d(weighted, 2, ceil_mode=True, count_include_pad=False),
        avg_pool2d(weight, 2, ceil_mode=True, count_include_pad=False),
    )
    below = interpolate(coarse, size=size, mode="bilinear", align_corners=False)
    trust = weight.clamp(0, 1)
    return torch.lerp(below, own, trust)
