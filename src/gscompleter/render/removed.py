"""Pixels that showed Gaussians which a user removed from the scene."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.image_ops import dilate
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, ContextScene

MIN_WEIGHT = 0.1
"""Compositing weight of removed Gaussians from which on a pixel shows them."""
MARGIN = 0.01
"""Width of the border around such pixels, relative to the longer side of the image."""


def mask_removed(source: ContextScene, camera: Camera, renderer: Renderer) -> Bool[Tensor, "h w"]:
    """Mark the pixels that showed something removed, and their border."""
    shown = find_removed(source, camera, renderer)
    return dilate(shown, max(round(MARGIN * max(shown.shape)), 1))


def find_removed(source: ContextScene, camera: Camera, renderer: Renderer) -> Bool[Tensor, "h w"]:
    """Mark the pixels that showed something removed."""
    given, removed = source.gaussians, source.removed
    others = replace(given, opacities=given.opacities.masked_fill(source.chosen_mask, 0.0))
    values = torch.cat([torch.zeros_like(given.opacities), torch.ones_like(removed.opacities)])
    return renderer.freeze(others, camera).extend(removed).splat(values) > MIN_WEIGHT
