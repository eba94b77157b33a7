"""Rotation of spherical harmonics (SH) in the basis of 3DGS."""

from __future__ import annotations

from math import isqrt

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.models.feed_forward.spherical_harmonics import rotate_sh

AXIS_PERMUTATION = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""Permutation of the axes of e3nn (pole along y) to those of 3DGS (pole along z)."""


def rotate_3dgs_sh(
    sh: Float[Tensor, "b v h w k 3"], turns: Float[Tensor, "b v 3 3"]
) -> Float[Tensor, "b v h w k 3"]:
    """Rotate SH of 3DGS such that `Y(R d) sh' = Y(d) sh` for all directions d."""
    # 3DGS flips the sign of odd orders, and has its pole along z instead of y.
    pole = turns.new_tensor(AXIS_PERMUTATION)
    degrees = range(isqrt(sh.shape[-2]))
    orders = [order for degree in degrees for order in range(-degree, degree + 1)]
    signs = torch.tensor([(-1.0) ** order for order in orders]).to(sh)[:, None]
    return signs * rotate_sh(signs * sh, pole.T @ turns @ pole)
