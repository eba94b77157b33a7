"""Lines that go on into a hole along the structure tensor of its surroundings.

After Weickert (Coherence-Enhancing Diffusion, 1999) and Bornemann and März (Fast Image Inpainting
Based on Coherence Transport, 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.generators.smooth import compute_distance_to_known, continue_smoothly, fit_membrane
from gscompleter.generators.warp import WarpedImage, fill_background_first, find_occluded
from gscompleter.types import Camera, GeneratorInput
from gscompleter.image_ops import blur_gaussian, dilate
from gscompleter.kernels.streamlines import trace_lines

GRADIENT_SIGMA, TENSOR_SIGMA = 1.0, 3.0
"""Standard deviations in pixels of the blurs before and after gradients are multiplied."""
OCCLUSION_BLUR = 3.0
"""Standard deviation in pixels of the blur of the mask of what was occluded."""
LINE_FIDELITY = 0.3
RIM = 2
"""Width in pixels of the border of a hole, where gradients see what fills it."""
REACH = 0.08
"""Length at which the weight of a line falls to 1/e, relative to the longer image side."""
MIN_WEIGHT = 0.1
"""Weight below which a line is given up."""


def continue_lines(
    image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Continue the lines of the known part of a filled `image` into the rest.

    Returns the colours that they carry, and their weights in [0, 1]: coherence, falling with the
    length; 0 where `known`.
    """
    xx, xy, yy = continue_structure_tensor(image, known).unbind(-1)
    contrast = torch.hypot(xx - yy, 2 * xy)
    coherence = (contrast / (xx + yy).clamp_min(1e-8)).where(~known, 0.0)
    angle = 0.5 * torch.atan2(2 * xy, xx - yy)
    directions = torch.stack([-angle.sin(), angle.cos()], dim=-1)
    reach = REACH * max(known.shape)
    limits = reach * (coherence / MIN_WEIGHT).clamp_min(1).log()
    limits = limits.where(limits > compute_distance_to_known(known), 0.0)
    colours, lengths = map(
        torch.from_numpy, trace_lines(*(x.numpy() for x in (image, known, directions, limits)))
    )
    return colours, coherence * torch.exp(-lengths / reach)


def continue_structure_tensor(
    image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Compute the structure tensor (xx, xy, yy) of the known part, continued into the rest."""
    luminance = blur_gaussian(image.mean(dim=-1), GRADIENT_SIGMA).numpy()
    x, y = (
        torch.from_numpy(cv2.Sobel(luminance, cv2.CV_32F, *order)) for order in ((1, 0), (0, 1))
    )
    inner = known & ~dilate(~known, RIM)
    seen = (inner if inner.any() else known).float()
    sums = blur_gaussian(torch.stack([x * x, x * y, y * y, torch.ones_like(x)], -1) * seen[..., None], TENSOR_SIGMA)
    return continue_smoothly(sums[..., :3] / sums[..., 3:].clamp_min(1e-6), seen)


def continue_image(
    warped: WarpedImage, target: Camera, context: GeneratorInput
) -> ContinuedImage:
    """Continue tone, lines and depth beyond the known pixels.

    The tone is a membrane over what is known and what lines carry. Behind objects the background
    is continued instead: a membrane does not know depth.
    """
    image, log_depth = fill_background_first(warped)
    depth = log_depth.exp().to(warped.depth.device)
    occluded = find_occluded(depth, target, context).cpu() & ~warped.known
    share = blur_gaussian(occluded.float(), OCCLUSION_BLUR)[..., None]
    carried, weight = continue_lines(image, warped.known)
    weight = weight[..., None] * (1 - share)
    known = warped.known[..., None]
    data = torch.where(known, image, carried)
    tone = fit_membrane(data, torch.where(known, 1.0, LINE_FIDELITY * weight**2)[..., 0])
    tone = torch.where(known, image, torch.lerp(tone, image, share))
    return ContinuedImage(tone, carried, weight, log_depth)


@dataclass(frozen=True)
class ContinuedImage:
    tone: Tensor
    carried: Tensor
    weight: Tensor
    log_depth: Tensor
