"""Transform of Gaussians from the frame of the first camera to the world."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.models.depth_anything.harmonics import rotate_3dgs_sh
from gscompleter.models.feed_forward.gaussian_adapter import PixelGaussians
from gscompleter.numerics.geometry import multiply_quats, rotations_to_quats


def move_from_first_camera(
    gaussians: PixelGaussians, first: Float[Tensor, "b 4 4"]
) -> PixelGaussians:
    """Transform Gaussians from the axes of cameras `first` to the world, without scaling."""
    views = gaussians.depth.shape[1]
    turns = first[:, None, :3, :3].expand(-1, views, -1, -1)
    shift = first[:, None, None, None, :3, 3]
    return replace(
        gaussians,
        means=torch.einsum("bvij,bvhwj->bvhwi", turns, gaussians.means) + shift,
        quats=multiply_quats(rotations_to_quats(turns)[:, :, None, None], gaussians.quats),
        sh=rotate_3dgs_sh(gaussians.sh, turns),
    )
