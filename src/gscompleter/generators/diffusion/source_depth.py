"""Depth of the photograph that PE-Field carries into the target camera: positive everywhere."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.generators.warp_inpaint.smooth import continued
from gscompleter.types import Render, View


@runtime_checkable
class SourceDepth(Protocol):
    """A photograph and the scene as its camera sees it -> z-depth in scene units."""

    def __call__(self, photograph: View, render: Render) -> Float[Tensor, "h w"]: ...


def context_depth(photograph: View, render: Render, min_alpha: float = 0.5) -> Float[Tensor, "h w"]:
    """Depth of the scene itself, so that the image fits it without any further alignment.

    Where the scene covers less than `min_alpha` of a pixel, the logarithm of the depth is
    continued smoothly from what surrounds it: next to the border the nearest depths, far from it
    the mean of all.

    Raises:
        InputError: where the photograph's camera sees nothing of the scene.
    """
    valid = (render.alpha >= min_alpha) & (render.depth > 0)
    if not valid.any():
        raise InputError(
            "The camera nearest to the target sees nothing of the scene, and PE-Field needs its "
            "depth there; bring a scene that the photographs show, or choose 'warp-inpaint'."
        )
    depth = torch.where(valid, render.depth, torch.ones_like(render.depth)).detach().cpu()
    middle = depth[valid.cpu()].median()
    log_depth = (depth / middle).log()[..., None]
    filled = continued(log_depth, valid.cpu().float())[..., 0].exp() * middle
    return torch.where(valid, render.depth, filled.to(render.depth.device))
