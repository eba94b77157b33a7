"""Lines that continue into a hole along the structure tensor around it.

After Weickert (Coherence-Enhancing Diffusion, 1999) and Bornemann and März (Fast Image Inpainting
Based on Coherence Transport, 2007).
"""

from __future__ import annotations

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.generators.smooth import compute_distance_to_known, continue_smoothly
from gscompleter.numerics.image_ops import blur_gaussian, dilate
from gscompleter.numerics.kernels.streamlines import trace_lines

GRADIENT_SIGMA, TENSOR_SIGMA = 1.0, 3.0
"""Standard deviations in pixels of the blurs before and after gradients are multiplied."""
RIM_WIDTH = 2
"""Width in pixels of the border around a hole whose gradients see the filling."""
REACH = 0.08
"""Length at which the weight of a line falls to 1/e, relative to the longer image side."""
MIN_WEIGHT = 0.1
"""Weight at which a line ends."""


def continue_lines(
    image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Continue the lines of the known part of a filled `image` into the rest.

    Returns the colours that they carry and their weights in [0, 1], which are the coherence, fall
    with the length, and are 0 where known.
    """
    xx, xy, yy = continue_structure_tensor(image, known).unbind(-1)
    coherence = torch.hypot(xx - yy, 2 * xy) / (xx + yy).clamp_min(1e-8)
    angle = 0.5 * torch.atan2(2 * xy, xx - yy)
    directions = torch.stack([-angle.sin(), angle.cos()], dim=-1)
    reach = REACH * max(known.shape)
    limits = reach * (coherence.where(~known, 0.0) / MIN_WEIGHT).clamp_min(1).log()
    limits = limits.where(limits > compute_distance_to_known(known), 0.0)
    arrays = (layer.contiguous().numpy() for layer in (image, known, directions, limits))
    colours, lengths = map(torch.from_numpy, trace_lines(*arrays))
    return colours, coherence * torch.exp(-lengths / reach)


def continue_structure_tensor(
    image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Compute the structure tensor (xx, xy, yy) of the known part, and continue it smoothly."""
    luminance = blur_gaussian(image.mean(dim=-1), GRADIENT_SIGMA).numpy()
    x = torch.from_numpy(cv2.Sobel(luminance, -1, 1, 0))
    y = torch.from_numpy(cv2.Sobel(luminance, -1, 0, 1))
    inner = known & ~dilate(~known, RIM_WIDTH)
    weight = (inner if inner.any() else known).to(image.dtype)
    sums = torch.stack([x * x, x * y, y * y, torch.ones_like(x)], dim=-1) * weight[..., None]
    sums = blur_gaussian(sums, TENSOR_SIGMA)
    return continue_smoothly(sums[..., :3] / sums[..., 3:].clamp_min(1e-6), weight)
