"""What earlier edits took out of a scene: photographs are ignored where they show it.

Photographs still show what a person removed or marked as wrong. Without this they would be evidence
for it: the next completion, or an update, would put it back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.render.protocols import Renderer
from gscompleter.render.removed import add_border, mark_shown
from gscompleter.types import Camera, Gaussians, View


@dataclass(frozen=True)
class TakenOut:
    """What earlier edits took out of a splat, in the frame of the result."""

    gaussians: Gaussians
    """These, without colours by direction."""
    scene: Gaussians
    """The splat as it is now."""
    occluders: Gaussians
    """Gaussians of the splat that may stand before it in a photograph."""
    renderer: Renderer

    def hide(self, view: View) -> View:
        """Ignore the pixels of a photograph that show it, and paint them over with the splat.

        They are painted over so that no model copies from ignored pixels.
        """
        mask = self.find(view.camera)
        if not mask.any():
            return view
        now = self.renderer.render(self.scene, view.camera).image.clamp(0, 1)
        image = torch.where(mask[..., None], now, view.image)
        return replace(view, image=image, ignore_mask=mask | ~view.valid_mask)

    def find(self, camera: Camera) -> Bool[Tensor, "h w"]:
        """Find the pixels that show it, with their border."""
        return add_border(mark_shown(self.gaussians, self.occluders, camera, self.renderer))
