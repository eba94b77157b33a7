"""Pictures of a target before its hole is painted, for painters outside of the program."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.generators.warp import BORDER_WIDTH, complete_warp
from gscompleter.numerics.image_ops import dilate
from gscompleter.stages.select_anchor import find_nearest_view
from gscompleter.stages.synthesize import make_generator_input
from gscompleter.stages.target_view import TargetView
from gscompleter.types import View


@dataclass(frozen=True)
class HolePictures:
    """Pictures of one target for whoever paints its hole; colours are in [0, 1]."""

    image: Float[Tensor, "h w 3"]
    """The render of the scene, over black."""
    mask: Bool[Tensor, "h w"]
    """True where to paint: the hole and `BORDER_WIDTH` pixels around it."""
    warped: Float[Tensor, "h w 3"]
    """Photographs warped to the target, with tone and lines continued into the hole."""
    depth: Float[Tensor, "h w"]
    """z-depth of the scene in its unit. 0 where the scene is empty; holes that it covers, and that
    are not trusted, have the depth of what covers them."""
    reference: View
    """The view of the context that is nearest to the target, of its own size."""


def draw_hole(view: TargetView) -> HolePictures:
    """Draw the pictures of a target, whose camera must not be padded: they have its size."""
    camera = view.camera.target
    context = make_generator_input(view)
    nearest = context.views[find_nearest_view(camera, context.views)]
    return HolePictures(
        image=view.render.image,
        # Pixels at the rim of a hole are a blend with the black behind it.
        mask=dilate(view.holes, BORDER_WIDTH),
        warped=complete_warp(nearest, camera, context).image,
        depth=torch.where(view.depth.valid, view.depth.depth, 0.0),
        reference=nearest,
    )
