"""Trust in the Gaussians of the context, as a given camera sees them.

The paper takes the context as right wherever it is opaque. A splat that somebody trained is opaque
everywhere, right or wrong, so there the photographs decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.render import FrozenScene
from gscompleter.types import Camera


@dataclass(frozen=True)
class HeldViews:
    """Views in which m Gaussians shall keep their colours."""

    centers: Float[Tensor, "v 3"]
    sums: Float[Tensor, "v m"]
    """Summed compositing weights of each Gaussian in each view, in pixels."""
    weights: Float[Tensor, "v"]
    """Weight of a pixel of each view, against one of the synthesized image."""


@runtime_checkable
class Trust(Protocol):
    """Trust in [0, 1] of each Gaussian of the context; added Gaussians always have 1."""

    def compute_alpha(self, frozen: FrozenScene, camera: Camera) -> Float[Tensor, "h w"]:
        """Render accumulated opacity with every Gaussian weighted by its trust."""

    def accept(self, frozen: FrozenScene, camera: Camera, weight: Float[Tensor, "h w"]) -> Trust:
        """Trust what a completed target shows as far as `weight`, like one more photograph."""

    def hold(self, photo_weight: float) -> HeldViews:
        """Return the photographs, with a weight, and completed targets, with weight 1."""

    def thin(self, rows: Int[Tensor, "r"], growth: Float[Tensor, "r"]) -> Trust:
        """Restrict to rows that stand for their neighbours, each enlarged by a factor."""


@dataclass(frozen=True)
class FullTrust:
    """Trust 1 everywhere: the paper's assumption, exact for a context that Ψ reconstructed."""

    def compute_alpha(self, frozen: FrozenScene, camera: Camera) -> Float[Tensor, "h w"]:
        """Return the rendered alpha itself."""
        return frozen.render.alpha

    def accept(
        self, frozen: FrozenScene, camera: Camera, weight: Float[Tensor, "h w"]
    ) -> FullTrust:
        """Return the same trust."""
        return self

    def hold(self, photo_weight: float) -> HeldViews:
        """Return no views, as nothing is ever recoloured."""
        return HeldViews(torch.empty(0, 3), torch.empty(0, 0), torch.empty(0))

    def thin(self, rows: Int[Tensor, "r"], growth: Float[Tensor, "r"]) -> FullTrust:
        """Return the same trust."""
        return self
