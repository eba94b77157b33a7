"""Image quality, each metric in one function with its formula."""

from __future__ import annotations

import math

from jaxtyping import Bool, Float
from torch import Tensor

MAX_PSNR = 100.0
"""PSNR of equal images, in dB, where the formula has no finite value."""


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
