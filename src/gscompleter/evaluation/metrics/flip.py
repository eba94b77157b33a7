"""FLIP, through NVIDIA's flip-evaluator (`pip install gscompleter[evaluation]`)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def compute_flip_map(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w"] | None:
    """Compute the FLIP error per pixel of two sRGB images; None if the package is missing."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    both = (x.clamp(0, 1).float().cpu().contiguous().numpy() for x in (truth, image))
    errors, _, _ = flip_evaluator.evaluate(*both, "LDR", applyMagma=False, computeMeanError=False)
    return torch.from_numpy(errors[..., 0].copy())
