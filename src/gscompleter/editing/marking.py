"""Gaussians of a splat that a user marked as wrong in images of it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.geometry import compute_z_depths, look_up
from gscompleter.render.mask_sums import sum_in_mask
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, Gaussians

MIN_SHOWN_WEIGHT = 1e-3
"""Compositing weight, summed over pixels, from which on a Gaussian is shown."""
BEHIND = 1.06
"""Depth relative to that of the marked surface up to which a Gaussian belongs to it."""


def find_marked(
    scene: Gaussians,
    cameras: Sequence[Camera],
    marks: Sequence[Bool[Tensor, "h w"]],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """Find the Gaussians that marks show: mostly inside of them, or at and before the surface.

    `marks` are True for pixels of the `cameras`, one each.
    """
    found = torch.zeros(len(scene), dtype=torch.bool, device=scene.means.device)
    for camera, mark in zip(cameras, marks, strict=True):
        frozen = renderer.freeze(scene, camera)
        sums = sum_in_mask(frozen, mark.to(scene.means))
        found |= (sums[:, 0] > sums[:, 1]) & (sums[:, 0] > MIN_SHOWN_WEIGHT)
        # What stands right behind the surface would come to light as a part of it.
        surface: Float[Tensor, "n"] = look_up(frozen.render.depth, scene, camera)
        z = compute_z_depths(scene.means, camera)
        found |= look_up(mark, scene, camera) & (z > 0) & (z <= BEHIND * surface)
    return found
