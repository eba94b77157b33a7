"""Continue colours smoothly beyond the border of what is known."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from torch import Tensor

BLUR = 1.5
"""Standard deviation, in pixels of its level, of the blur on every level of the pyramid."""
REACH = 0.7
"""Standard deviation of what a pixel averages over, as a share of its distance from the known."""


def distance_to_known(known: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Pixels to the nearest known pixel; 0 where known. Some pixel must be known."""
    away = cv2.distanceTransform((~known).numpy().astype(np.uint8), cv2.DIST_L2, 5)
    return torch.from_numpy(away)


def continued(
    values: Float[Tensor, "h w c"], weight: Float[Tensor, "h w"]
) -> Float[Tensor, "h w c"]:
    """`values` where `weight` is positive, and weighted means of what lies around elsewhere.

    A pixel averages over a neighbourhood that grows with its distance from what is known: just
    beyond the border it continues the nearest values, far away it tends
    to the mean. Averages grow with distance evenly in all directions, which a pyramid that fills
    its blocks (`push_pull`) does not do.
    """
    known = weight > 0
    if not known.any():
        return torch.zeros_like(values)
    weighted = torch.cat([values * weight[..., None], weight[..., None]], dim=-1).numpy()
    layers = mean_pyramid(np.ascontiguousarray(weighted, np.float32))

    size = REACH * distance_to_known(known).numpy()
    level = np.log2(np.maximum(size / BLUR, 1.0)).clip(0, len(layers) - 1)
    below = np.minimum(level.astype(np.int64), max(len(layers) - 2, 0))
    above = np.minimum(below + 1, len(layers) - 1)
    share = (level - below)[..., None].astype(np.float32)
    rows, columns = np.indices(level.shape)
    mixed = (1 - share) * layers[below, rows, columns] + share * layers[above, rows, columns]
    return torch.where(known[..., None], values, torch.from_numpy(mixed))


def mean_pyramid(weighted: Float32[ndarray, "h w c"]) -> Float32[ndarray, "levels h w values"]:
    """Weighted means over wider and wider neighbourhoods, each twice as wide as the one before.

    The last channel of `weighted` is the weight that the others were multiplied by. Where a
    neighbourhood holds no weight, the mean of the next wider one stands in.
    """
    h, w = weighted.shape[:2]
    sums = []
    while True:
        blurred = cv2.GaussianBlur(weighted, (0, 0), BLUR)
        sums.append(cv2.resize(blurred, (w, h), interpolation=cv2.INTER_LINEAR))
        if min(weighted.shape[:2]) <= 8:
            break
        half = ((weighted.shape[1] + 1) // 2, (weighted.shape[0] + 1) // 2)
        # Of odd sizes OpenCV averages four channels at most, so that each goes by itself.
        planes = [cv2.resize(p, half, interpolation=cv2.INTER_AREA) for p in cv2.split(blurred)]
        weighted = np.stack(planes, axis=-1)

    total = sums[0].sum(axis=(0, 1))
    wider = np.broadcast_to(total[:-1] / total[-1], (h, w, len(total) - 1))
    means = []
    for layer in reversed(sums):
        own = layer[..., :-1] / np.maximum(layer[..., -1:], 1e-12)
        wider = np.where(layer[..., -1:] > 1e-6, own, wider).astype(np.float32)
        means.append(wider)
    return np.stack(means[::-1])
