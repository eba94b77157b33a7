"""Image quality, each metric in one function with its formula."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MAX_PSNR = 100.0
"""PSNR of equal images, in dB, where the formula has no finite value."""

LUMINANCE = (0.299, 0.587, 0.114)
"""Shares of red, green and blue (ITU-R BT.601)."""


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

    scikit-image with an 11-pixel Gaussian window, colour channels averaged, range 1. Both sides
    of the image must be at least 11 pixels long.
    """
    # Here, so that what is to be scored need not wait for scikit-image and SciPy.
    from skimage.metrics import structural_similarity

    return float(
        structural_similarity(
            image.clamp(0, 1).cpu().numpy(),
            truth.cpu().numpy(),
            win_size=11,
            gaussian_weights=True,
            channel_axis=-1,
            data_range=1.0,
        )
    )


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
