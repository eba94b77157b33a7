"""Pixels that showed Gaussians which a user removed from the scene."""

from __future__ import annotations

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.image_ops import dilate
from gscompleter.render.cache import make_camera_key
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, ContextScene, Gaussians

MIN_REMOVED_WEIGHT = 0.1
"""Compositing weight of removed Gaussians from which on a pixel shows them."""
REMOVED_MARGIN = 0.01
"""Width of the border around such pixels, relative to the longer side of the image."""


def mask_removed(source: ContextScene, camera: Camera, renderer: Renderer) -> Bool[Tensor, "h w"]:
    """Mark the pixels that showed something removed, and their border."""
    return add_border(find_removed(source, camera, renderer))


def add_border(shown: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Add the border of pixels that showed something removed."""
    return dilate(shown, max(round(REMOVED_MARGIN * max(shown.shape)), 1))


def find_removed(source: ContextScene, camera: Camera, renderer: Renderer) -> Bool[Tensor, "h w"]:
    """Mark the pixels that showed something removed; a camera that is known is not drawn again."""
    known = source.removed_pixels
    key = make_camera_key(camera)
    if key not in known:
        known[key] = draw_removed(source, camera, renderer)
    return known[key]


def draw_removed(source: ContextScene, camera: Camera, renderer: Renderer) -> Bool[Tensor, "h w"]:
    """Draw the removed Gaussians among those that are left or were revealed, and mark them."""
    scene = source.gaussians
    # What is chosen for removal is among `removed`, too, and must not be drawn twice. What gave way
    # to photographs hides nothing.
    hidden = source.chosen_mask | source.replaced_mask
    return mark_shown(source.removed, scene.hide(hidden), camera, renderer)


def mark_shown(
    gaussians: Gaussians, others: Gaussians, camera: Camera, renderer: Renderer
) -> Bool[Tensor, "h w"]:
    """Mark the pixels that show Gaussians among others."""
    # With a value of 1 for these and 0 for the others, the image is their weight.
    values = torch.cat([torch.zeros_like(others.opacities), torch.ones_like(gaussians.opacities)])
    drawn = gaussians.drop_colors()
    hiding = renderer.freeze(drawn, camera).freeze_occluders(others.drop_colors())
    return hiding.extend(drawn).splat(values) > MIN_REMOVED_WEIGHT
