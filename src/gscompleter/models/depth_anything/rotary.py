"""Rotary position embedding (RoPE) in two dimensions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

NUM_PAIRS = 16
"""Number of channel pairs rotated by the row of a patch, and by its column."""
FREQUENCY_BASE = 100.0
"""Approximate ratio of the highest to the lowest frequency."""


@dataclass(frozen=True)
class RotaryEmbedding:
    """Cosines and sines of the rotation of each token's channel pairs."""

    cos: Float[Tensor, "t 2 pairs"]
    sin: Float[Tensor, "t 2 pairs"]

    def __call__(self, x: Float[Tensor, "n heads t c"]) -> Float[Tensor, "n heads t c"]:
        """Rotate channel pairs k and k + 16 of each half."""
        # The rotation of each pair (u, v) as of a complex number, for rows and columns apart.
        u, v = x.unflatten(-1, (2, 2, NUM_PAIRS)).unbind(-2)
        rotated = (u * self.cos - v * self.sin, v * self.cos + u * self.sin)
        return torch.stack(rotated, dim=-2).flatten(-3)


def compute_rotary_embedding(places: Int[Tensor, "t 2"]) -> RotaryEmbedding:
    """Compute the rotations of tokens at rows and columns."""
    k = torch.arange(NUM_PAIRS, device=places.device)
    angles = places[..., None] * FREQUENCY_BASE ** (-k / NUM_PAIRS)
    return RotaryEmbedding(angles.cos(), angles.sin())


def list_view_positions(rows: int, columns: int, device: torch.device) -> Int[Tensor, "t 2"]:
    """List the row and column of each token: 0, 0 for the class token, patches from 1."""
    grid = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)) + 1
    return torch.cat([torch.zeros(1, 2, dtype=torch.long), grid]).to(device)


def list_shared_positions(views: int, patches: int, device: torch.device) -> Int[Tensor, "t 2"]:
    """List positions that only distinguish patches (1) from other tokens (0)."""
    view_tokens = torch.ones(1 + patches, 2, dtype=torch.long, device=device)
    view_tokens[0] = 0
    return view_tokens.repeat(views, 1)
