"""Real spherical harmonics in the basis and with the signs of 3DGS."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.types import SH_C0

SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154)
SH_C3_CUBE = 1.445305721320277


def evaluate_colors(
    sh: Float[Tensor, "n k 3"], means: Float[Tensor, "n 3"], center: Float[Tensor, "3"]
) -> Float[Tensor, "n 3"]:
    """Evaluate colours as seen from `center`: `max(0, 0.5 + sum of basis * sh)`.

    Differentiable in `sh` and, through the direction, in `means`.
    """
    if sh.shape[1] == 1:
        return (0.5 + SH_C0 * sh[:, 0]).clamp_min(0)
    directions = torch.nn.functional.normalize(means - center, dim=-1)
    basis = evaluate_sh_basis(directions, sh.shape[1])
    return (0.5 + torch.einsum("nk,nkc->nc", basis, sh)).clamp_min(0)


def evaluate_sh_basis(directions: Float[Tensor, "n 3"], k: int) -> Float[Tensor, "n k"]:
    """Evaluate the first `k` (1, 4, 9 or 16) basis functions at unit `directions` (world)."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, SH_C0)]
    if k >= 4:
        basis += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if k >= 9:
        basis += [
            SH_C2[0] * x * y,
            -SH_C2[0] * y * z,
            SH_C2[1] * (2 * zz - xx - yy),
            -SH_C2[0] * x * z,
            SH_C2[2] * (xx - yy),
        ]
    if k >= 16:
        basis += [
            -SH_C3[0] * y * (3 * xx - yy),
            SH_C3[1] * x * y * z,
            -SH_C3[2] * y * (4 * zz - xx - yy),
            SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -SH_C3[2] * x * (4 * zz - xx - yy),
            SH_C3_CUBE * z * (xx - yy),
            -SH_C3[0] * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)
