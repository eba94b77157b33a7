"""Choice of the reference camera if no poses are given."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor


def select_reference_view(tokens: Float[Tensor, "b v c"]) -> Int[Tensor, "b"]:
    """Select the view whose token is least extreme in similarity, norm and variance."""
    unit = F.normalize(tokens, dim=-1)
    # Mean cosine to the other views, without that of each view to itself.
    likeness = (unit @ unit.transpose(1, 2)).sum(-1) - 1
    likeness = likeness / (tokens.shape[1] - 1)
    measures = torch.stack([likeness, tokens.norm(dim=-1), unit.var(dim=-1)])
    # Each measure is mapped to [0, 1] over the views; 0.5 is the middle.
    low, high = measures.aminmax(dim=-1, keepdim=True)
    ranked = (measures - low) / (high - low + 1e-8)
    return (ranked - 0.5).abs().sum(0).argmin(-1)


def order_views(reference: Int[Tensor, "b"], views: int) -> Int[Tensor, "b v"]:
    """Order view indices with the reference first."""
    numbers = torch.arange(views, device=reference.device).expand(len(reference), -1)
    first = (numbers != reference[:, None]).int()
    return first.argsort(dim=1, stable=True)
