"""Lines that continue into a hole along the structure tensor around it.

Edges of the image would otherwise end at the border of a hole (decision 042). A line runs from a
pixel of the hole in both directions along the edge direction there, up to known pixels.

After Weickert (Coherence-Enhancing Diffusion, 1999) and Bornemann and März (Fast Image Inpainting
Based on Coherence Transport, 2007).
"""

from __future__ import annotations

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.image_ops import blur_gaussian, dilate
from gscompleter.numerics.kernels.streamlines import trace_lines
from gscompleter.numerics.smooth import compute_distance_to_known, continue_smoothly

GRADIENT_SIGMA = 1.0
"""Standard deviation in pixels of the blur before gradients are taken."""
TENSOR_SIGMA = 3.0
"""Standard deviation in pixels of the blur of the products of gradients."""
RIM_WIDTH = 2
"""Width in pixels of the rim of known pixels whose gradients depend on the filling of a hole."""
LINE_DECAY = 0.08
"""Length at which the weight of a line falls to 1/e, relative to the longer image side."""
LINE_END_WEIGHT = 0.1
"""Weight at which a line ends."""


def continue_lines(
    image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Continue the lines of the known part of `image` into the rest.

    The rest of `image` holds a filling, which lines do not copy. Returns, per pixel, the colour
    that its line carries from known pixels, and the weight of that colour in [0, 1]: the coherence
    times exp(-length / reach), and 0 where known. All tensors are on the CPU.
    """
    # With the eigenvalues a >= b of the tensor, the coherence is (a - b) / (a + b): 1 at an edge, 0
    # where no direction prevails. `angle` is that of the first eigenvector, along the gradient; a
    # line runs at a right angle to it.
    xx, xy, yy = continue_structure_tensor(image, known).unbind(-1)
    coherence = torch.hypot(xx - yy, 2 * xy) / (xx + yy).clamp_min(1e-8)
    angle = 0.5 * torch.atan2(2 * xy, xx - yy)
    directions = torch.stack([-angle.sin(), angle.cos()], dim=-1)

    # A line is given up at the length at which its weight falls below LINE_END_WEIGHT. Where even
    # the straight way to a known pixel is longer, none is traced. Lengths are in pixels.
    reach = LINE_DECAY * max(known.shape)
    limits = reach * (coherence.where(~known, 0.0) / LINE_END_WEIGHT).clamp_min(1).log()
    limits = limits.where(limits > compute_distance_to_known(known), 0.0)

    layers = (image, known, directions, limits)
    traced = trace_lines(*(layer.contiguous().numpy() for layer in layers))
    colors, lengths = (torch.from_numpy(array) for array in traced)
    return colors, coherence * torch.exp(-lengths / reach)


def continue_structure_tensor(
    image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Compute the structure tensor (xx, xy, yy) of the known part, and continue it smoothly."""
    luminance = blur_gaussian(image.mean(dim=-1), GRADIENT_SIGMA).numpy()
    x = torch.from_numpy(cv2.Sobel(luminance, -1, 1, 0))
    y = torch.from_numpy(cv2.Sobel(luminance, -1, 0, 1))

    # Gradients beside the hole are partly those of the filling, whose edges would be continued. If
    # nothing is known beyond the rim, the rim itself is taken.
    inner = known & ~dilate(~known, RIM_WIDTH)
    weight = (inner if inner.any() else known).to(image.dtype)
    # A normalized blur: products and their weights are blurred alike, then divided.
    sums = torch.stack([x * x, x * y, y * y, torch.ones_like(x)], dim=-1) * weight[..., None]
    sums = blur_gaussian(sums, TENSOR_SIGMA)
    return continue_smoothly(sums[..., :3] / sums[..., 3:].clamp_min(1e-6), weight)
