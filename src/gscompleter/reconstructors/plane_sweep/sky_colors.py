"""Colours of the sky in the directions of each photograph (decision 156).

Photographs against the sun show it white, and those with the sun behind them blue. Each direction
is kept from one of them, so that seams would cross the sky.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.geometry import is_inside, project, sample
from gscompleter.numerics.image_ops import push_pull, smooth_masked
from gscompleter.numerics.sky import compute_sky_depth
from gscompleter.types import View

FEATHER = 0.25
"""Distance from the border of a sky within which its weight rises to 1, as a share of the shorter
image side."""
MIN_SKY_WEIGHT = 0.02
"""Least weight, in all views together, of a direction in which the sky counts as shown."""
TONE_SHARE = 1 / 16
"""Radius within which the tone of a sky changes alike, as a share of the shorter image side: clouds
stay as their photograph shows them."""


def blend_skies(
    views: Sequence[View], skies: Sequence[Bool[Tensor, "_ _"]]
) -> list[Float[Tensor, "_ _ 3"] | None]:
    """Compute the colour of the sky in the direction of each pixel of each view.

    A view without a sky has none. `skies` mark the sky of each view. There a view keeps its own
    detail, in the mean tone of all that show the direction. Behind its surfaces it gets what others
    show, or else a continuation.
    Of one or two views each keeps its own colours, as on surfaces (decision 043).
    """
    # The host waits for a GPU once and not for each view.
    has_sky = torch.stack([sky.any() for sky in skies]).tolist()
    numbers = [number for number, has in enumerate(has_sky) if has]
    weights = {number: weigh_sky(skies[number]) for number in numbers}
    blended: list[Tensor | None] = [None] * len(views)
    for number in numbers:
        view = views[number]
        sky = skies[number]
        # Exposures are not normalized: a sky that is clipped to white would become grey.
        points = view.camera.center + compute_sky_depth(view.camera) * view.camera.z_rays()
        total = weights[number]
        colors = total[..., None] * view.image
        others = [other for other in numbers if other != number and len(views) > 2]
        for other in others:
            shown = views[other]
            pixels, z = project(points, shown.camera)
            layers = torch.cat([shown.image, weights[other][..., None]], dim=-1)
            sampled = sample(layers, pixels)
            counted = sampled[..., 3] * is_inside(pixels, z, shown.camera)
            colors = colors + counted[..., None] * sampled[..., :3]
            total = total + counted
        mean = colors / total.clamp_min(1e-6)[..., None]
        radius = max(1, round(TONE_SHARE * min(sky.shape)))
        tone = smooth_masked((mean - view.image).where(sky[..., None], 0.0), sky, radius)
        image = (view.image + tone).clamp(0, 1).where(sky[..., None], mean)
        is_shown = sky | (total > MIN_SKY_WEIGHT)
        blended[number] = push_pull(image, is_shown.to(image.dtype))
    return blended


def weigh_sky(sky: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Weigh the pixels of a sky by their distance from its border and from that of the image.

    So a mean over views has no seam where a view ends.
    """
    padded = np.pad(sky.cpu().numpy().astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    weight = np.minimum(distance / (FEATHER * min(sky.shape)), 1).astype(np.float32)
    return torch.from_numpy(weight).to(sky.device)
