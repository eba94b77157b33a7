"""Where a patch lies, told by turning its queries and keys (RoPE in two dimensions)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

PAIRS = 16
"""Pairs of channels that turn with the row of a patch, and as many with its column."""
BASE = 100.0
"""The slowest pair turns almost this many times slower than the fastest."""


@dataclass(frozen=True)
class Turns:
    """Cosines and sines by which the pairs of channels of each token are turned."""

    cos: Float[Tensor, "t 2 pairs"]
    sin: Float[Tensor, "t 2 pairs"]

    def __call__(self, x: Float[Tensor, "n heads t c"]) -> Float[Tensor, "n heads t c"]:
        """`x` turned: channel k goes with channel k + 16 of the same half."""
        u, v = x.unflatten(-1, (2, 2, PAIRS)).unbind(-2)
        turned = (u * self.cos - v * self.sin, v * self.cos + u * self.sin)
        return torch.stack(turned, dim=-2).flatten(-3)


def turns_at(places: Int[Tensor, "t 2"]) -> Turns:
    """The turns of tokens at rows and columns."""
    k = torch.arange(PAIRS, device=places.device)
    angles = places[..., None] * BASE ** (-k / PAIRS)
    return Turns(angles.cos(), angles.sin())


def places_in_view(rows: int, columns: int, device: torch.device) -> Int[Tensor, "t 2"]:
    """Row and column of each token of a view: the first one belongs to no patch and lies at 0, 0;
    patches count from 1."""
    grid = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)) + 1
    return torch.cat([torch.zeros(1, 2, dtype=torch.long), grid]).to(device)


def places_among_views(views: int, patches: int, device: torch.device) -> Int[Tensor, "t 2"]:
    """Of the tokens of all views together only whether they belong to a patch is told."""
    of_view = torch.ones(1 + patches, 2, dtype=torch.long, device=device)
    of_view[0] = 0
    return of_view.repeat(views, 1)
