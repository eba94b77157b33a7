"""After a target: let additions fade towards the border of the padded image (not in the paper).

The padding ends where it ends, and not where the scene does. A camera that moves on would see a
straight black edge there; a fill that fades looks like what it is (decision 059).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.geometry import is_inside, project
from gscompleter.stages.target_view import TargetView
from gscompleter.types import Gaussians

FADED_SHARE = 0.125
"""Part of the padding over which additions fade."""
MIN_DRAWN_OPACITY = 1 / 255
"""Opacity below which a Gaussian is not drawn by any renderer."""


def fade_border(added: Gaussians, view: TargetView) -> Gaussians:
    """Fade additions over the outer part of the padding, unless a photograph looks there.

    The target itself does not see them. Without padding nothing changes.
    """
    if compute_width(view) == 0 or len(added) == 0:
        return added
    camera = view.camera.padded
    pixels, _ = project(added.means, camera)
    size = pixels.new_tensor([camera.width, camera.height])
    distance = torch.minimum(pixels, size - pixels).amin(dim=-1)
    share = (distance / compute_width(view)).clamp(0, 1)

    # What photographs see was fitted to them.
    for photo in view.state.photos:
        pixels, z = project(added.means, photo.view.camera)
        share = share.where(~is_inside(pixels, z, photo.view.camera), 1.0)
    if bool((share == 1).all()):
        return added
    faded = replace(added, opacities=share * added.opacities, encoded=None)
    return faded[faded.opacities >= MIN_DRAWN_OPACITY]


def find_fading_border(view: TargetView) -> Bool[Tensor, "h w"]:
    """Find the pixels of the padded target in which additions may fade."""
    camera = view.camera.padded
    width = math.ceil(compute_width(view))
    border = torch.ones(
        (camera.height, camera.width), dtype=torch.bool, device=view.render.alpha.device
    )
    border[width : camera.height - width, width : camera.width - width] = False
    return border


def compute_width(view: TargetView) -> float:
    """Compute the width of the border over which additions fade, in pixels."""
    return FADED_SHARE * min(view.camera.left, view.camera.top)
