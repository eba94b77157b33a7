"""Removal guard (not in the paper): fill only the hole that removed Gaussians leave."""

from __future__ import annotations

from jaxtyping import Bool
from torch import Tensor

from gscompleter.geometry import project_mask
from gscompleter.guards import Guard
from gscompleter.image_ops import dilate
from gscompleter.render import Renderer
from gscompleter.stages.target_view import TargetView
from gscompleter.types import Camera, Gaussians

MIN_WEIGHT = 0.1
"""Compositing weight of removed Gaussians from which on a pixel shows them."""
MARGIN = 0.01
"""Width of the border around such pixels, relative to the longer side of the image."""


class Removal(Guard):
    """Add nothing where the scene looked the same before the removal."""

    name = "removal"

    def place(self, candidates: Gaussians, view: TargetView) -> Gaussians:
        """Keep candidates in pixels that showed something removed."""
        camera, source = view.camera.padded, view.state.source
        shown = mask_removed(source.gaussians, source.chosen_mask, camera, view.scenes.renderer)
        return candidates[project_mask(shown, candidates, camera)]


def mask_removed(
    scene: Gaussians, removed: Bool[Tensor, "n"], camera: Camera, renderer: Renderer
) -> Bool[Tensor, "h w"]:
    """Mark the pixels that show Gaussians of `scene` that are removed from it, and their border."""
    weight = renderer.freeze(scene, camera).splat(removed.float())
    return dilate(weight > MIN_WEIGHT, max(round(MARGIN * max(weight.shape)), 1))
