"""The embedded Φ: warp what the photographs saw into the target, and fill what none of them saw.

It needs no weights. Observed pixels come from the photographs through the depth of the scene
(`warp`), all in one exposure (`harmonize`), and so does what they show where the scene itself is
empty. The rest takes its tone from a smooth continuation of its border (`smooth`) and, as far as
the border can tell, its structure from patches of the photographs (`exemplar`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.generators.smooth import distance_to_known
from gscompleter.generators.warp import (
    Warped,
    background_first,
    warp_photographs,
    with_unexplained,
)
from gscompleter.generators.warp_inpaint.exemplar import Sources, fill_by_patches
from gscompleter.interpolation import smoothed
from gscompleter.types import Camera, SceneContext, View

STRUCTURE_REACH = 0.15
"""How far into a hole structure is continued, relative to the longer side of the image; it fades
out on the second half of the way. Nothing tells what lies deeper, and a wrong guess is worse than
none."""
TONE_RADIUS = 4
"""Pixels over which a hole keeps the mean colour of its smooth continuation. Patches alone look as
plausible but drift in tone."""
CRACK_WIDTH = 4
"""Gaps of at most this many pixels are closed smoothly: patches have nothing to add there."""


@dataclass(frozen=True)
class WarpInpaint:
    """Φ without weights: depth-aware warp of all photographs, then exemplar-based filling."""

    seed: int = 0
    """Of the random search for patches; the same seed gives the same bytes."""

    def __call__(
        self, nearest: View, target: Camera, context: SceneContext
    ) -> Float[Tensor, "h w 3"]:
        """The image `target` would take, completely filled, in [0, 1]."""
        warped = warp_photographs(nearest, target, context)
        if not warped.known.any():
            # Nothing of the scene is in sight: there is no border to continue.
            return nearest.image.mean(dim=(0, 1)).expand(target.height, target.width, 3)
        warped = with_unexplained(warped, target, context).to("cpu")
        image = self.with_structure(*background_first(warped), warped, context)
        return image.clamp(0, 1).to(nearest.image.device)

    def with_structure(
        self,
        tone: Float[Tensor, "h w 3"],
        log_depth: Float[Tensor, "h w"],
        warped: Warped,
        context: SceneContext,
    ) -> Float[Tensor, "h w 3"]:
        """The smoothly completed image `tone`, with structure along the borders of its holes."""
        reach = STRUCTURE_REACH * max(warped.known.shape)
        away = distance_to_known(warped.known)
        undecided = without_cracks(~warped.known, CRACK_WIDTH) & (away <= reach)
        if not undecided.any():
            return tone
        sources = sources_of(context, warped)
        patched = fill_by_patches(tone, ~undecided, log_depth, sources, self.seed)
        detail = patched - tone
        detail = detail - smoothed(detail, undecided, TONE_RADIUS)
        fading = (2 * (1 - away / reach)).clamp(0, 1)
        return torch.where(undecided[..., None], tone + fading[..., None] * detail, tone)


def without_cracks(hole: Bool[Tensor, "h w"], width: int) -> Bool[Tensor, "h w"]:
    """The parts of `hole` that are wider than `width` pixels. The image's border is no limit."""
    kernel = np.ones((width + 1, width + 1), np.uint8)
    padded = np.pad(hole.numpy().astype(np.uint8), width + 1, mode="edge")
    opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, kernel)
    inner = slice(width + 1, -width - 1)
    return torch.from_numpy(opened[inner, inner] > 0)


def sources_of(context: SceneContext, warped: Warped) -> Sources:
    """All photographs in one exposure, and what is known of the target itself."""
    photographs = [
        (gain * view.image.cpu()).clamp(0, 1)
        for view, gain in zip(context.views, warped.gains, strict=True)
    ]
    trusted = [view.trusted.cpu() for view in context.views]
    return Sources.stacked(
        [*photographs, warped.image],
        [*trusted, warped.known],
        [*(render.depth.cpu() for render in context.at_views), warped.depth],
    )
