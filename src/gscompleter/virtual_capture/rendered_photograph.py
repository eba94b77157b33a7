"""A render of a splat in place of a photograph, where photographs are asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8

from gscompleter.render.protocols import Renderer
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.types import Camera, Gaussians
from gscompleter.virtual_capture.render_views import render_views


@dataclass(frozen=True, eq=False)
class RenderedPhotograph:
    """A photograph (`data/photograph.py`) that is rendered each time its pixels are read."""

    camera: Camera
    scene: Gaussians
    renderer: Renderer

    def measure(self) -> tuple[int, int]:
        """Return the size of the camera's image."""
        return self.camera.width, self.camera.height

    def read_orientation(self) -> int:
        """Return 1: renders are upright."""
        return 1

    def read_pixels(self) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        """Render in 8 bits, as a photograph has; transparent where nothing is known."""
        (view,) = render_views(self.scene, [self.camera], self.renderer)
        colors: UInt8[np.ndarray, "h w 3"] = convert_to_pixels(view.image)
        return colors, view.valid_mask.to(torch.uint8).mul(255).cpu().numpy()
