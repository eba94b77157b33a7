"""The default Φ, without weights: warped photographs, and holes filled with patches.

The tone of a hole continues its border smoothly; structure near the border comes from patches.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.generators.smooth import average_trusted, compute_distance_to_known
from gscompleter.generators.warp import (
    WarpedImage,
    add_unexplained,
    fill_background_first,
    warp_photographs,
)
from gscompleter.generators.warp_inpaint.exemplar import Sources, fill_by_patches
from gscompleter.image_ops import smooth_masked
from gscompleter.types import Camera, GeneratorInput, View

STRUCTURE_REACH = 0.15
"""Depth of structure in a hole, relative to the longer image side; its second half fades."""
TONE_RADIUS = 4
"""Radius in pixels over which patches keep the tone of the smooth continuation."""
CRACK_WIDTH = 4
"""Width in pixels up to which gaps are filled smoothly, without patches."""


@dataclass(frozen=True)
class WarpInpaint:
    """Φ by depth-aware warping of all photographs and exemplar-based filling."""

    seed: int = 0

    def __call__(
        self, nearest: View, target: Camera, context: GeneratorInput
    ) -> Float[Tensor, "h w 3"]:
        """Synthesize the complete image of `target`, in [0, 1].

        A scene that is not fully trusted gets smooth colours, which cannot be wrong in structure.
        """
        render, trusted_alpha = context.target_render, context.trusted_alpha
        if trusted_alpha is None or trusted_alpha is render.alpha:
            return self.fill_holes(nearest, target, context)
        return average_trusted(render, trusted_alpha / render.alpha.clamp_min(1e-6))

    def fill_holes(
        self, nearest: View, target: Camera, context: GeneratorInput
    ) -> Float[Tensor, "h w 3"]:
        """Synthesize the image of `target` from warped photographs and patches."""
        warped = warp_photographs(nearest, target, context)
        if not warped.known.any():
            # The target observes nothing, so there is no border to continue.
            return nearest.image.mean(dim=(0, 1)).expand(target.height, target.width, 3)
        warped = add_unexplained(warped, target, context).to("cpu")
        image = self.add_structure(*fill_background_first(warped), warped, context)
        return image.clamp(0, 1).to(nearest.image.device)

    def add_structure(
        self,
        tone: Float[Tensor, "h w 3"],
        log_depth: Float[Tensor, "h w"],
        warped: WarpedImage,
        context: GeneratorInput,
    ) -> Float[Tensor, "h w 3"]:
        """Add structure to the smooth image `tone` along the borders of its holes."""
        reach = STRUCTURE_REACH * max(warped.known.shape)
        away = compute_distance_to_known(warped.known)
        undecided = remove_cracks(~warped.known, CRACK_WIDTH) & (away <= reach)
        if not undecided.any():
            return tone
        sources = collect_sources(context, warped)
        patched = fill_by_patches(tone, ~undecided, log_depth, sources, self.seed)
        detail = patched - tone
        detail = detail - smooth_masked(detail, undecided, TONE_RADIUS)
        fading = (2 * (1 - away / reach)).clamp(0, 1)
        return torch.where(undecided[..., None], tone + fading[..., None] * detail, tone)


def remove_cracks(hole: Bool[Tensor, "h w"], width: int) -> Bool[Tensor, "h w"]:
    """Keep the parts of `hole` wider than `width` pixels; the image border is no limit."""
    kernel = np.ones((width + 1, width + 1), np.uint8)
    padded = np.pad(hole.numpy().astype(np.uint8), width + 1, mode="edge")
    opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, kernel)
    inner = slice(width + 1, -width - 1)
    return torch.from_numpy(opened[inner, inner] > 0)


def collect_sources(context: GeneratorInput, warped: WarpedImage) -> Sources:
    """Collect patch sources: photographs of equal exposure, and the known target pixels."""
    photographs = [
        (gain * view.image.cpu()).clamp(0, 1)
        for view, gain in zip(context.views, warped.gains, strict=True)
    ]
    trusted = [view.static_mask.cpu() for view in context.views]
    return Sources.stack_images(
        [*photographs, warped.image],
        [*trusted, warped.known],
        [*(render.depth.cpu() for render in context.view_renders), warped.depth],
    )
