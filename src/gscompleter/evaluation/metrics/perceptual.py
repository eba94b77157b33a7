"""HaarPSI and FLIP, which do not reward blur; LPIPS and FID, which compare learned features.

HaarPSI (Reisenhofer et al., A Haar Wavelet-Based Perceptual Similarity Index, 2018) compares Haar
wavelets, which differ where only one image has an edge. FLIP is NVIDIA's flip-evaluator, LPIPS and
FID are torchmetrics' (`gscompleter[evaluation]`). ST-LPIPS is in `st_lpips.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from gscompleter.system.errors import InputError

Image = Float[Tensor, "h w 3"]

GMSD_CONSTANT = 30.0
"""Constant of the similarity, in units of 8-bit colours; fitted by the authors."""
ALPHA = 4.2
"""Steepness of the logistic function; fitted by the authors."""
YIQ = ((0.299, 0.587, 0.114), (0.5959, -0.2746, -0.3213), (0.2115, -0.5227, 0.3112))
"""Conversion from RGB to luminance and two chrominances."""
MISSING = (ImportError, OSError, RuntimeError)
"""Errors without a package, without weights, and with a torchvision for another torch."""
LPIPS_ADVICE = "run `pip install gscompleter[evaluation]`, and the first time with a connection."


def haarpsi(image: Image, truth: Image, where: Bool[Tensor, "h w"]) -> float | None:
    """Compute HaarPSI of two images in [0, 1] over the pixels of `where`; 1 is best.

    Images are halved first, as published; a pixel counts if half of its area is in `where`. None
    without such a pixel.
    """
    of_image = convert_to_yiq(image)
    of_truth = convert_to_yiq(truth)
    similarity, weight = compute_similarities(of_image, of_truth)
    inside = halve_channels(where[None].double().cpu())[0] >= 0.5
    if not inside.any():
        return None
    similarity = similarity[:, inside]
    weight = weight[:, inside]
    # Without any edge all pixels have the same weight.
    # The mean of logistic values, weighted by edges, is mapped back by its inverse.
    tiny = torch.finfo(weight.dtype).eps
    mean = ((ALPHA * similarity).sigmoid() * (weight + tiny)).sum() / (weight + tiny).sum()
    return (mean.logit() / ALPHA).square().item()


def convert_to_yiq(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "3 half_h half_w"]:
    """Convert to YIQ in units of 8-bit colours, at half the size."""
    colours = 255 * image.clamp(0, 1).double().cpu()
    return halve_channels((colours @ colours.new_tensor(YIQ).T).movedim(-1, 0))


def compute_similarities(
    a: Float[Tensor, "3 h w"], b: Float[Tensor, "3 h w"]
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "3 h w"]]:
    """Compare two finer scales of luminance, and chrominance; the coarsest scale gives weights."""
    of_a = [compute_wavelets(a[0], scale) for scale in (1, 2, 3)]
    of_b = [compute_wavelets(b[0], scale) for scale in (1, 2, 3)]
    luminance = compare_values(torch.stack(of_a[:2]), torch.stack(of_b[:2])).mean(0)
    chrominance = compare_values(average_neighbours(a[1:]), average_neighbours(b[1:])).mean(0)
    weight = torch.maximum(of_a[2], of_b[2])
    # The authors take the mean of the two directions as weight of the chrominance.
    return torch.cat([luminance, chrominance[None]]), torch.cat([weight, weight.mean(0)[None]])


def compare_values(a: Float[Tensor, "*n"], b: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Compute (2 a b + c) / (a² + b² + c), which is 1 for equal values."""
    return (2 * a * b + GMSD_CONSTANT) / (a**2 + b**2 + GMSD_CONSTANT)


def compute_wavelets(luminance: Float[Tensor, "h w"], scale: int) -> Float[Tensor, "2 h w"]:
    """Compute magnitudes of Haar wavelets of 2^scale pixels, along columns and rows."""
    size = 2**scale
    # A square of which one half counts positive and the other negative.
    step = luminance.new_full((size, size), 1 / size)
    step[size // 2 :] *= -1
    # An even window has no middle pixel: it reaches one pixel further after its place than before.
    before = size // 2 - 1
    after = size // 2
    padded = pad(luminance[None, None], (before, after, before, after))
    return conv2d(padded, torch.stack([step, step.T])[:, None])[0].abs()


def average_neighbours(values: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    """Compute magnitudes of the means of 2 x 2 pixels, one for every pixel."""
    return avg_pool2d(pad(values, (0, 1, 0, 1)), 2, stride=1).abs()


def halve_channels(values: Float[Tensor, "c h w"]) -> Float[Tensor, "c half_h half_w"]:
    """Average 2 x 2 pixels, with black beyond an odd side."""
    h, w = values.shape[1:]
    return avg_pool2d(pad(values, (0, w % 2, 0, h % 2)), 2)


def compute_flip_map(image: Image, truth: Image) -> Float[Tensor, "h w"] | None:
    """Compute the FLIP error per pixel of two sRGB images; None if the package is missing."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    both = (x.clamp(0, 1).float().cpu().contiguous().numpy() for x in (truth, image))
    errors, _, _ = flip_evaluator.evaluate(*both, "LDR", applyMagma=False, computeMeanError=False)
    return torch.from_numpy(errors[..., 0].copy())


@torch.no_grad()
def compute_lpips(image: Image, truth: Image, network: Literal["vgg", "alex"]) -> float | None:
    """Compute LPIPS of two images, clipped to [0, 1]; 0 is best. None if it is not available."""
    metric = load_lpips(network)
    return None if metric is None else float(metric(to_batch(image), to_batch(truth)))


@cache
def load_lpips(network: Literal["vgg", "alex"]) -> Any | None:
    """Load the metric, and download its weights on first use; None if that fails."""
    try:
        # Imported here because the package imports torchvision.
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        return LearnedPerceptualImagePatchSimilarity(net_type=network, normalize=True)
    except MISSING:
        return None


def compute_fid(images: Sequence[Image], truths: Sequence[Image]) -> float:
    """Compute |μ - μ'|² + tr(Σ + Σ' - 2 (Σ Σ')^½) of 2,048 Inception features; 0 is best."""
    try:
        from torchmetrics.image.fid import FrechetInceptionDistance

        metric = FrechetInceptionDistance(feature=2048, normalize=True)
    except MISSING as error:
        raise InputError(f"FID is not available ({error}); {LPIPS_ADVICE}") from error
    for side, group in (("photographs", truths), ("rendered images", images)):
        if len(group) < 2:
            raise InputError(f"FID needs at least two {side}, got {len(group)}.")
        for image in group:
            metric.update(to_batch(image), real=group is truths)
    return float(metric.compute())


def to_batch(image: Image) -> Float[Tensor, "1 3 h w"]:
    """Clip an image to [0, 1] and make it a batch in torch's layout, on the CPU."""
    return image.clamp(0, 1).permute(2, 0, 1)[None].float().cpu()
