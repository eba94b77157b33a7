"""Pictures of a target before its hole is painted."""

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
    """Pictures of one target for whoever paints its hole, at the size of its camera."""

    image: Float[Tensor, "h w 3"]
    """As the scene shows it, over black."""
    mask: Bool[Tensor, "h w"]
    """True where to paint: the hole with its dark rim."""
    warped: Float[Tensor, "h w 3"]
    """Photographs warped to the target, with tone and lines continued into the hole."""
    depth: Float[Tensor, "h w"]
    """z-depth of the scene in its unit, 0 in holes."""
    reference: View
    """The nearest photograph of the context."""


def draw_hole(view: TargetView) -> HolePictures:
    """Collect the pictures of a target that is not padded."""
    camera = view.camera.target
    context = make_generator_input(view)
    nearest = context.views[find_nearest_view(camera, context.views)]
    depth = view.render.depth_map()
    return HolePictures(
        image=view.render.image,
        mask=dilate(view.holes, BORDER_WIDTH),
        warped=complete_warp(nearest, camera, context).image,
        depth=torch.where(depth.valid, depth.depth, 0.0),
        reference=nearest,
    )
