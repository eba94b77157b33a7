"""FLIP, through NVIDIA's flip-evaluator (`pip install gscompleter[evaluation]`)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def flip_map(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w"] | None:
    """How much each pixel of two images differs to who flips between them; 0 is best, 1 worst.

    Images are sRGB in [0, 1]; 67 pixels fill a degree of sight, as the package takes it by itself.
    None where the package is missing.
    """
    try:
        # Here and not above: it is optional.
        import flip_evaluator
    except ImportError:
        return None
    both = (x.clamp(0, 1).float().cpu().contiguous().numpy() for x in (truth, image))
    errors, _, _ = flip_evaluator.evaluate(*both, "LDR", applyMagma=False, computeMeanError=False)
    return torch.from_numpy(errors[..., 0].copy())
