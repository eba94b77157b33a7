"""Places along the outline of something removed where the scene goes on as it was.

Where an object ends, whatever is beside it lies behind it or has another colour. Where both are
the same on either side, the selection ended within a surface: of the object, so that a part of it
is left, or of something that it touches.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.image_ops import dilate, smooth_masked
from gscompleter.types import Camera, Render

WIDTH = 0.01
"""Width of the outline, relative to the longer side of the image."""
MIXED = 1
"""Pixels at either side of an outline that show both what was removed and what is beside it."""
MAX_SLOPE = 2.0
"""Tangent of the angle between a surface and the image plane up to which it counts as one."""
MAX_COLOR_STEP = 0.12
"""Largest difference of a channel between both sides of an outline within one surface, beyond the
deviations of its texture."""
MAX_CHANGE = 0.1
"""Largest change of a channel by the completion of a pixel that shows what it showed before."""


@dataclass(frozen=True)
class Outline:
    """The outline of what was removed, in one image."""

    pixels: Bool[Tensor, "h w"]
    """The pixels along the outline, outside of it."""
    continued: Bool[Tensor, "h w"]
    """Those of them that show the surface inside of it going on."""

    @property
    def share(self) -> float:
        """Share of the outline beyond which the surface goes on."""
        return self.continued.sum().item() / max(self.pixels.sum().item(), 1)


def trace_outline(
    removed: Bool[Tensor, "h w"], before: Render, after: Render, camera: Camera
) -> Outline:
    """Compare both sides of the outline of the pixels that showed something removed."""
    width = max(round(WIDTH * max(removed.shape)), 2)
    pixels = dilate(removed, width) & ~removed

    # Colour, its square and depth of the scene before, on average over either side of each pixel.
    # The windows reach beyond the mixed pixels from wherever in the outline.
    surface = before.depth_map()
    image = before.image
    layers = torch.cat([image, image.square(), before.depth[..., None]], dim=-1)
    radius = width + MIXED + 1
    inside = smooth_masked(layers, surface.valid & ~dilate(~removed, MIXED), radius)
    outside = smooth_masked(layers, surface.valid & ~dilate(removed, MIXED), radius)

    # The depth of a slanted surface changes by its slope over the focal length from pixel to pixel,
    # and the middles of both windows are about one radius apart.
    largest_step = MAX_SLOPE * radius / camera.K[0, 0] * outside[..., 6]
    # Nothing on either side has depth 0, and is no surface.
    is_one_surface = (inside - outside)[..., 6].abs() < largest_step

    # The variance is the mean of the squares without the square of the mean.
    sides = torch.stack([inside, outside])
    variance = sides[..., 3:6] - sides[..., :3].square()
    texture = variance.mean(dim=0).clamp_min(0.0).sqrt()
    color_step = (inside - outside)[..., :3].abs()
    is_one_color = (color_step <= MAX_COLOR_STEP + texture).all(dim=-1)

    is_as_before = ((image - after.image).abs() <= MAX_CHANGE).all(dim=-1)
    continued = pixels & surface.valid & is_one_surface & is_one_color & is_as_before
    return Outline(pixels, continued)
