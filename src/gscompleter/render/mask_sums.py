"""How much of each Gaussian of a frozen scene shows inside and outside of a mask."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.render.protocols import FrozenScene


def sum_in_mask(frozen: FrozenScene, inside: Float[Tensor, "h w"]) -> Float[Tensor, "n 3"]:
    """Sum how much of each Gaussian is shown inside and outside of a mask; the third sum is 0."""
    # A backprojection takes three channels.
    return frozen.backproject(torch.stack([inside, 1 - inside, torch.zeros_like(inside)], dim=-1))
