"""Image metrics, one function each."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.image_ops import SSIM_RADIUS, SSIM_SIGMA

MAX_PSNR = 100.0
"""PSNR in dB of equal images."""

LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue (ITU-R BT.601)."""


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Compute PSNR in dB: -10 log10(mean((clip(image) - truth)²)) with peak 1; NaN if one is."""
    error = (image.clamp(0, 1) - truth).double().square().mean().item()
    # NaN stays: `min` returns its first argument unless the second one is smaller.
    return MAX_PSNR if error == 0 else min(-10 * math.log10(error), MAX_PSNR)


def compute_masked_psnr(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> float | None:
    """Compute PSNR in dB over the pixels of `where`, or None if there are none."""
    return psnr(image[where][None], truth[where][None]) if where.any() else None


def ssim(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Compute SSIM as scikit-image does: 11-pixel Gaussian window, sample covariances, range 1."""
    a = image.clamp(0, 1).cpu().numpy()
    b = truth.cpu().numpy()
    # Window pixels beyond the border are unknown; scikit-image leaves out the border likewise.
    inner = compute_ssim_map(a, b)[SSIM_RADIUS:-SSIM_RADIUS, SSIM_RADIUS:-SSIM_RADIUS]
    if inner.size == 0:
        raise ValueError(f"SSIM needs 11 x 11 pixels, got {a.shape[1]} x {a.shape[0]}")
    # In the precision of the images, as scikit-image rounds the mean of the channels.
    channels = [inner[..., channel].mean(dtype=np.float64) for channel in range(3)]
    return float(np.array(channels, a.dtype).mean())


def compute_masked_ssim(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> float | None:
    """Compute SSIM over the pixels of `where` that are not at the border; None without any.

    Elsewhere the image is taken as right, so that what lies beside a pixel does not count.
    """
    shown = torch.where(where[..., None], image.clamp(0, 1), truth)
    inner = slice(SSIM_RADIUS, -SSIM_RADIUS)
    counted = where.cpu().numpy()[inner, inner]
    similar = compute_ssim_map(shown.cpu().numpy(), truth.cpu().numpy())[inner, inner]
    return float(similar[counted].mean(dtype=np.float64)) if counted.any() else None


def compute_ssim_map(
    a: Float[np.ndarray, "h w 3"], b: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Compute the structural similarity (Wang et al. 2004) at each pixel."""
    # Sample instead of population covariances: n / (n - 1) for the n pixels of the window.
    unbiased = (2 * SSIM_RADIUS + 1) ** 2 / ((2 * SSIM_RADIUS + 1) ** 2 - 1)
    mean_a = blur_in_window(a)
    mean_b = blur_in_window(b)
    var_a = unbiased * (blur_in_window(a * a) - mean_a * mean_a)
    var_b = unbiased * (blur_in_window(b * b) - mean_b * mean_b)
    cov = unbiased * (blur_in_window(a * b) - mean_a * mean_b)
    # Constants of the paper, (0.01 L)² and (0.03 L)² with the range L = 1.
    c1 = 0.01**2
    c2 = 0.03**2
    similar = (2 * mean_a * mean_b + c1) * (2 * cov + c2)
    return similar / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))


def blur_in_window(values: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Blur with a Gaussian window, summed in float64 and rounded after each direction."""
    weights = np.exp(-0.5 / SSIM_SIGMA**2 * np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) ** 2)
    line = weights / weights.sum()
    point = np.ones(1)
    down = cv2.sepFilter2D(values, cv2.CV_64F, point, line).astype(values.dtype)
    return cv2.sepFilter2D(down, cv2.CV_64F, line, point).astype(values.dtype)


def compute_gradient_energy_ratio(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> float | None:
    """Compute the gradient energy of `image` over that of `truth`: 1 is as sharp, 0 is flat.

    Squared central differences of luminance are summed over pixels of `where` with all four
    neighbours in `where`. This measures sharpness, not whether edges are correct. None without such
    a pixel or gradient.
    """
    # Central differences need the four neighbours of a pixel.
    there = where[1:-1, 1:-1] & where[:-2, 1:-1] & where[2:, 1:-1]
    there = there & where[1:-1, :-2] & where[1:-1, 2:]
    energies = [compute_gradient_energy(x)[there].sum().item() for x in (image.clamp(0, 1), truth)]
    return energies[0] / energies[1] if energies[1] > 0 else None


def compute_gradient_energy(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h-2 w-2"]:
    """Compute the squared gradient of luminance per pixel, by central differences."""
    luminance = image.double() @ image.new_tensor(LUMINANCE, dtype=torch.float64)
    down = (luminance[2:, 1:-1] - luminance[:-2, 1:-1]) / 2
    along = (luminance[1:-1, 2:] - luminance[1:-1, :-2]) / 2
    return down**2 + along**2
