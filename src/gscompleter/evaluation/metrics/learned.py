"""LPIPS and FID, which compare learned features: torchmetrics' (`gscompleter[evaluation]`)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError

Image = Float[Tensor, "h w 3"]

MISSING = (ImportError, OSError, RuntimeError)
"""Errors without a package, without weights, and with a torchvision for another torch."""
ADVICE = "run `pip install gscompleter[evaluation]`, and the first time with a connection."


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
    """Compute |μ - μ'|² + tr(Σ + Σ' - 2 (Σ Σ')^½) of 2,048 Inception features; 0 is best.

    The estimate is biased: compare sets of equal size only, with thousands of images if possible.

    Raises:
        InputError: The metric is not available, or a side has fewer than two images.
    """
    try:
        from torchmetrics.image.fid import FrechetInceptionDistance

        metric = FrechetInceptionDistance(feature=2048, normalize=True)
    except MISSING as error:
        raise InputError(f"FID is not available ({error}); {ADVICE}") from error
    for side, found in (("photographs", truths), ("rendered images", images)):
        if len(found) < 2:
            raise InputError(f"FID needs at least two {side}, got {len(found)}.")
        for image in found:
            metric.update(to_batch(image), real=found is truths)
    return float(metric.compute())


def to_batch(image: Image) -> Float[Tensor, "1 3 h w"]:
    """Clip an image to [0, 1] and make it a batch in torch's layout, on the CPU."""
    return image.clamp(0, 1).permute(2, 0, 1)[None].float().cpu()
