"""Transform of Gaussians from the frame of the first camera to the world."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import quats_from, quats_product
from gscompleter.reconstructors.depth_anything.harmonics import turned_harmonics
from gscompleter.reconstructors.feed_forward.gaussian_adapter import PixelGaussians


def placed(gaussians: PixelGaussians, first: Float[Tensor, "b 4 4"]) -> PixelGaussians:
    """Transform Gaussians from the axes of cameras `first` to the world, without scaling."""
    views = gaussians.depth.shape[1]
    turns = first[:, None, :3, :3].expand(-1, views, -1, -1)
    shift = first[:, None, None, None, :3, 3]
    return replace(
        gaussians,
        means=torch.einsum("bvij,bvhwj->bvhwi", turns, gaussians.means) + shift,
        quats=quats_product(quats_from(turns)[:, :, None, None], gaussians.quats),
        sh=turned_harmonics(gaussians.sh, turns),
    )
