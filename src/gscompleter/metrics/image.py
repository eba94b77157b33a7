"""Image quality, each metric in one function with its formula."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

MAX_PSNR = 100.0
"""PSNR of equal images, in dB, where the formula has no finite value."""

LUMINANCE = (0.299, 0.587, 0.114)
"""Shares of red, green and blue (ITU-R BT.601)."""

RADIUS, SIGMA = 5, 1.5
"""Of the Gaussian window of SSIM, in pixels."""


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Peak signal-to-noise ratio in dB: -10 log10(mean((clip(image) - truth)^2)), peak 1."""
    error = (image.clamp(0, 1) - truth).double().square().mean().item()
    return min(-10 * math.log10(error), MAX_PSNR) if error > 0 else MAX_PSNR


def masked_psnr(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> float | None:
    """PSNR in dB over the pixels of `where` only; None where there are none.

    With the hole mask it judges what was generated, with its complement what was observed.
    """
    return psnr(image[where][None], truth[where][None]) if where.any() else None


def ssim(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Structural similarity as MVSplat and DepthSplat report it.

    With an 11-pixel Gaussian window, the covariances of a sample, colour channels averaged, range
    1: what scikit-image gives, which takes longer to be imported than to answer. Both sides of the
    image must be at least 11 pixels long.
    """
    a, b = image.clamp(0, 1).cpu().numpy(), truth.cpu().numpy()
    inner = similarities(a, b)[RADIUS:-RADIUS, RADIUS:-RADIUS]
    if inner.size == 0:
        raise ValueError(f"SSIM needs 11 x 11 pixels, got {a.shape[1]} x {a.shape[0]}")
    channels = [inner[..., channel].mean(dtype=np.float64) for channel in range(3)]
    return float(np.array(channels, a.dtype).mean())


def similarities(
    a: Float[np.ndarray, "h w 3"], b: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """The structural similarity of two images (Wang et al. 2004) at each of their pixels."""
    unbiased = (2 * RADIUS + 1) ** 2 / ((2 * RADIUS + 1) ** 2 - 1)
    mean_a, mean_b = blurred(a), blurred(b)
    var_a = unbiased * (blurred(a * a) - mean_a * mean_a)
    var_b = unbiased * (blurred(b * b) - mean_b * mean_b)
    cov = unbiased * (blurred(a * b) - mean_a * mean_b)
    c1, c2 = 0.01**2, 0.03**2
    similar = (2 * mean_a * mean_b + c1) * (2 * cov + c2)
    return similar / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))


def blurred(values: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Means under a Gaussian window, summed in float64 and rounded after each direction."""
    weights = np.exp(-0.5 / SIGMA**2 * np.arange(-RADIUS, RADIUS + 1) ** 2)
    line, point = weights / weights.sum(), np.ones(1)
    down = cv2.sepFilter2D(values, cv2.CV_64F, point, line).astype(values.dtype)
    return cv2.sepFilter2D(down, cv2.CV_64F, line, point).astype(values.dtype)


def gradient_energy_ratio(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> float | None:
    """Gradient energy of `image` over that of `truth`: 1 is as sharp as the photograph, 0 is flat.

    The sum of squared central differences of the luminance, over the pixels of `where` whose four
    neighbours lie in it too, so that the border of a hole is no gradient. It tells sharpness and
    nothing of whether the edges are the true ones. None where there is no such pixel, or the
    photograph has no gradient there.
    """
    there = where[1:-1, 1:-1] & where[:-2, 1:-1] & where[2:, 1:-1]
    there = there & where[1:-1, :-2] & where[1:-1, 2:]
    energies = [gradient_energy(x)[there].sum().item() for x in (image.clamp(0, 1), truth)]
    return energies[0] / energies[1] if energies[1] > 0 else None


def gradient_energy(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h-2 w-2"]:
    """Squared length of the gradient of luminance per pixel, by central differences."""
    luminance = image.double() @ image.new_tensor(LUMINANCE, dtype=torch.float64)
    down = (luminance[2:, 1:-1] - luminance[:-2, 1:-1]) / 2
    along = (luminance[1:-1, 2:] - luminance[1:-1, :-2]) / 2
    return down**2 + along**2
