"""ST-LPIPS: learned perceptual similarity that tolerates small shifts of the image.

Ghildyal and Liu, Shift-tolerant Perceptual Similarity Metric, ECCV 2022: LPIPS over an AlexNet that
was trained with low-pass filters instead of strides. Only the weights of the package
stlpips-pytorch (`gscompleter[evaluation]`) are read; its code imports torchvision.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, normalize, pad

ST_LPIPS_PACKAGE = "stlpips_pytorch"
ST_LPIPS_WEIGHTS = Path("weights", "vST0.0", "alex_shift_tolerant.pth")
"""File of the weights in the package."""
LAYERS = (
    ("slice1.0", 2, "before"),
    ("slice2.5", 2, "after pooling"),
    ("slice3.9", 1, "after pooling"),
    ("slice4.11", 1, None),
    ("slice5.13", 1, None),
)
"""Name and padding of each convolution, and when the size is halved: `before` its rectifier; `after
pooling`, before the convolution, behind a maximum over 3 x 3 pixels; or never."""
MIN_NETWORK_SIDE = 21
"""Shortest side of an image of which the third layer can still be halved, in pixels."""

Weights = Mapping[str, Tensor]


@torch.no_grad()
def compute_st_lpips(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float | None:
    """Compute ST-LPIPS (AlexNet) of two images, clipped to [0, 1]; 0 is best.

    None without the package, and for images with a side below `MIN_NETWORK_SIDE`.
    """
    weights = load_weights()
    if weights is None or min(image.shape[:2]) < MIN_NETWORK_SIDE:
        return None
    pair = torch.stack([image, truth]).clamp(0, 1).movedim(-1, 1).float().cpu()
    total = 0.0
    for number, features in enumerate(compute_features(pair, weights)):
        # Features have length 1 at each pixel; the weights of their differences were learned.
        of_image, of_truth = normalize(features, dim=1, eps=1e-10)
        weight = weights[f"lin{number}.model.1.weight"][0]
        total += float(((of_image - of_truth).square() * weight).sum(0).mean())
    return total


def compute_features(images: Float[Tensor, "n 3 h w"], weights: Weights) -> list[Tensor]:
    """Compute the rectified features of the five layers."""
    shift, scale = weights["scaling_layer.shift"], weights["scaling_layer.scale"]
    values = (2 * images - 1 - shift) / scale
    features = []
    for name, padding, halving in LAYERS:
        if halving == "after pooling":
            values = halve_smoothly(max_pool2d(values, 3, stride=1))
        kernel, bias = weights[f"net.{name}.weight"], weights[f"net.{name}.bias"]
        values = conv2d(values, kernel, bias, padding=padding)
        if halving == "before":
            values = halve_smoothly(values)
        values = values.relu()
        features.append(values)
    return features


def halve_smoothly(values: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c half_h half_w"]:
    """Halve the size after a binomial filter of 3 x 3 pixels, with 2 mirrored ones around.

    n pixels become (n + 1) // 2 + 1, as in the authors' code.
    """
    line = values.new_tensor([1.0, 2.0, 1.0]) / 4
    channels = values.shape[1]
    kernel = (line[:, None] * line).expand(channels, 1, 3, 3)
    return conv2d(pad(values, (2, 2, 2, 2), mode="reflect"), kernel, stride=2, groups=channels)


@cache
def load_weights() -> Weights | None:
    """Load the weights of the package, without importing it; None if it is not installed."""
    found = find_spec(ST_LPIPS_PACKAGE)
    for folder in (found and found.submodule_search_locations) or ():
        if (path := Path(folder) / ST_LPIPS_WEIGHTS).is_file():
            weights: Weights = torch.load(path, map_location="cpu", weights_only=True)
            return weights
    return None
