"""Removal guard (not in the paper): fill only the hole that removed Gaussians leave."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.geometry import project_mask
from gscompleter.guards import Guard
from gscompleter.image_ops import dilate
from gscompleter.render import Renderer
from gscompleter.stages.target_view import TargetView
from gscompleter.types import Camera, ContextScene, Gaussians

MIN_WEIGHT = 0.1
"""Compositing weight of removed Gaussians from which on a pixel shows them."""
MARGIN = 0.01
"""Width of the border around such pixels, relative to the longer side of the image."""


class Removal(Guard):
    """Add nothing where the scene looked the same before the removal."""

    name = "removal"

    def place(self, candidates: Gaussians, view: TargetView) -> Gaussians:
        """Keep candidates in pixels that showed something removed."""
        camera = view.camera.padded
        shown = mask_removed(view.state.source, camera, view.scenes.renderer)
        return candidates[project_mask(shown, candidates, camera)]


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
