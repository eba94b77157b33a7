"""Smooth interpolation of partly known images, and structural similarity."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

DARKEST = 0.05
"""Smallest colour that tells how bright a surface is; darker ones are noise."""
BRIGHTEST = 0.95
"""Largest one; brighter ones may be clipped."""
MIN_CONTRAST = 0.02
"""Range of brightness in 5 x 5 smoothed pixels that counts as texture; colours are in [0, 1]."""
SSIM_RADIUS = 5
"""Radius of the Gaussian window of SSIM, in pixels."""
SSIM_SIGMA = 1.5
"""Standard deviation of the window, in pixels."""
THIN_RADIUS = 2
"""Half the width, in pixels, of a square that fits into nothing thin: 5 pixels."""
MARK_COLOR = (1.0, 0.0, 1.0)
"""A colour that no scene has: magenta."""
MAX_REGIONS = 3
"""Most regions that are listed, the largest first."""


def fill_smoothly(
    values: Float[Tensor, "h w"], known: Bool[Tensor, "h w"], num_relaxations: int = 64
) -> Float[Tensor, "h w"]:
    """Interpolate smoothly outside the mask `known`: `push_pull`, relaxed towards a membrane.

    If nothing is known, the result is zero.
    """
    weight = known.to(values.dtype)
    filled = push_pull(values[..., None], weight)[..., 0]
    for _ in range(num_relaxations):
        filled = torch.where(known, values, average_four_neighbours(filled))
    return filled


def average_four_neighbours(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Compute the mean of the four neighbours of each pixel, extending the border."""
    padded = pad(values[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    total = padded[:-2, 1:-1] + padded[2:, 1:-1]
    total += padded[1:-1, :-2]
    total += padded[1:-1, 2:]
    return total.div_(4)


def push_pull(
    values: Float[Tensor, "h w c"], weight: Float[Tensor, "h w"]
) -> Float[Tensor, "h w c"]:
    """Interpolate `values` into the pixels of zero `weight` through a pyramid of averages.

    See Gortler et al., The Lumigraph, 1996. If all weights are zero, the result is 0.
    """
    weighted = (values * weight[..., None]).permute(2, 0, 1)[None]
    filled = _fill_from_coarse(weighted, weight[None, None])
    return filled[0].permute(1, 2, 0)


def _fill_from_coarse(
    weighted: Float[Tensor, "1 c h w"], weight: Float[Tensor, "1 1 h w"]
) -> Float[Tensor, "1 c h w"]:
    """Fill what has no weight from an image of half the size, which is filled first."""
    own = weighted / weight.clamp_min(1e-8)
    size = (weight.shape[2], weight.shape[3])
    # A full image needs no smaller ones. To ask a GPU for that takes longer than to compute them.
    if max(size) == 1 or (not weight.is_cuda and bool((weight > 0).all())):
        return own
    coarse = _fill_from_coarse(
        avg_pool2d(weighted, 2, ceil_mode=True, count_include_pad=False),
        avg_pool2d(weight, 2, ceil_mode=True, count_include_pad=False),
    )
    below = interpolate(coarse, size=size, mode="bilinear", align_corners=False)
    return torch.where(weight > 0, own, below)


def smooth_masked(
    values: Float[Tensor, "h w c"], mask: Bool[Tensor, "h w"], radius: int
) -> Float[Tensor, "h w c"]:
    """Average `values` over the pixels of `mask` in a square of 2 radius + 1 pixels."""
    weight = mask.to(values.dtype)[..., None]
    layers = torch.cat([values * weight, weight], dim=-1)
    side = 2 * radius + 1
    sums = cv2.boxFilter(
        layers.cpu().numpy(), -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    totals = torch.from_numpy(sums).to(values)
    return totals[..., :-1] / totals[..., -1:].clamp_min(1e-8)


def average_box(values: Float[Tensor, "h w"], radius: int) -> Float[Tensor, "h w"]:
    """Average the pixels of the image in a square of 2 radius + 1 pixels."""
    side = 2 * radius + 1
    return avg_pool2d(values[None, None], side, 1, radius, count_include_pad=False)[0, 0]


def blur_gaussian(values: Float[Tensor, "h w *c"], sigma: float) -> Float[Tensor, "h w *c"]:
    """Blur an image by a Gaussian of standard deviation `sigma` in pixels."""
    return torch.from_numpy(cv2.GaussianBlur(values.cpu().numpy(), (0, 0), sigma)).to(values)


def paint_marked(
    image: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
    color: tuple[float, float, float] = MARK_COLOR,
) -> Float[Tensor, "h w 3"]:
    """Paint the pixels of `mask` over an image."""
    return torch.where(mask[..., None], image.new_tensor(color), image)


def dilate(mask: Bool[Tensor, "h w"], radius: int) -> Bool[Tensor, "h w"]:
    """Dilate `mask` by a square of 2 radius + 1 pixels."""
    side = 2 * radius + 1
    grown = mask[None, None].float()
    # The square in two passes, along x and along y.
    for size, padding in (((1, side), (0, radius)), ((side, 1), (radius, 0))):
        grown = max_pool2d(grown, size, stride=1, padding=padding)
    return grown[0, 0] > 0


def keep_thin(mask: Bool[Tensor, "h w"], radius: int = THIN_RADIUS) -> Bool[Tensor, "h w"]:
    """Keep the structures of a mask that no square of 2 radius + 1 pixels fits into.

    A mask goes on beyond the border of the image: what is `radius` pixels wide along it is thin,
    and what is wider is not.
    """
    # A morphological opening leaves what the square fits into. One pixel more, as rims of wide
    # structures are not straight.
    shrunk = ~dilate(~mask, radius)
    return mask & ~dilate(shrunk, radius + 1)


def label_regions(mask: Bool[Tensor, "h w"]) -> tuple[Int64[Tensor, "h w"], int]:
    """Label the connected regions of `mask` (8 neighbours) from 1, and count the labels with 0."""
    pixels = mask.cpu().numpy().astype(np.uint8)
    count, labels = cv2.connectedComponents(pixels, connectivity=8)
    return torch.from_numpy(labels).long().to(mask.device, non_blocking=True), count


def find_largest_regions(
    mask: Bool[Tensor, "h w"], left: int, top: int
) -> tuple[tuple[int, int, int, int], ...]:
    """Find the bounding boxes (left, top, right, bottom) of the largest connected regions.

    The corner of the mask has the coordinates `left`, `top`; right and bottom are exclusive.
    """
    pixels = mask.cpu().numpy().astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(pixels, connectivity=8)
    regions = stats[1:]  # the first component is the background
    largest_first = (-regions[:, cv2.CC_STAT_AREA]).argsort(kind="stable")
    largest = regions[largest_first][:MAX_REGIONS]
    return tuple(
        (left + int(x), top + int(y), left + int(x + width), top + int(y + height))
        for x, y, width, height, _ in largest
    )


def is_enclosed(mask: Bool[Tensor, "h w"]) -> bool:
    """Return True if `mask` is not empty and does not touch the border of the image."""
    return bool(mask.any()) and int(mask.sum()) == int(mask[1:-1, 1:-1].sum())


def ssim_map(
    image: Float[Tensor, "h w 3"], other: Float[Tensor, "h w 3"]
) -> Float[Tensor, "1 3 h w"]:
    """Compute structural similarity (Wang et al. 2004) around each pixel, padding with black."""
    line = torch.exp(-(torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1.0) ** 2) / (2 * SSIM_SIGMA**2))
    weights = (line / line.sum()).tolist()

    def blur(values: Float[Tensor, "h w 3"]) -> Tensor:
        padded = pad(values.permute(2, 0, 1)[None], (SSIM_RADIUS,) * 4)
        return correlate(correlate(padded, weights, 3), weights, 2)

    # Local means a and b, variances aa and bb, and covariance ab.
    a = blur(image)
    b = blur(other)
    aa = blur(image**2) - a**2
    bb = blur(other**2) - b**2
    ab = blur(image * other) - a * b
    # The constants of the paper, for colours in [0, 1].
    c1 = 0.01**2
    c2 = 0.03**2
    return (2 * a * b + c1) * (2 * ab + c2) / ((a**2 + b**2 + c1) * (aa + bb + c2))


def correlate(values: Tensor, weights: Sequence[float], dim: int) -> Tensor:
    """Correlate `values` with a line of weights along one dimension, without padding.

    For a depthwise filter this takes a quarter of the time of `conv2d`.
    """
    size = values.shape[dim] - len(weights) + 1
    total = weights[0] * values.narrow(dim, 0, size)
    for start, weight in enumerate(weights[1:], 1):
        total.add_(values.narrow(dim, start, size), alpha=weight)
    return total


def compute_mask_fraction(mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None) -> float:
    """Compute the fraction of True or positive pixels; 0 without a mask."""
    return 0.0 if mask is None else (mask > 0).float().mean().item()
