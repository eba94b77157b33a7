"""Trust in the Gaussians of the context, as a given camera sees them.

The paper takes the context as right wherever it is opaque. A splat that somebody trained is opaque
everywhere, right or wrong, so there the photographs decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from gscompleter.render.protocols import FrozenScene
from gscompleter.system.files.mapping import join_rows
from gscompleter.types import Camera


@dataclass(frozen=True)
class HeldViews:
    """Views in which m Gaussians shall keep their colours."""

    centers: Float[Tensor, "v 3"]
    sums: Float[Tensor, "v m"]
    """Summed compositing weights of each Gaussian in each view, in pixels."""
    weights: Float[Tensor, "v"]
    """Weight of a pixel of each view, against one of the synthesized image."""

    def add(self, camera: Camera, sums: Float[Tensor, "m"]) -> HeldViews:
        """Hold one more view, with weight 1."""
        return HeldViews(
            torch.cat([self.centers, camera.center.to(self.centers)[None]]),
            join_rows([self.sums, sums[None]]),
            torch.cat([self.weights, self.weights.new_ones(1)]),
        )


@dataclass(frozen=True)
class Trust:
    """Trust in [0, 1] of each Gaussian of the context; added Gaussians always have 1.

    This one is 1 everywhere: the paper's assumption, exact for a context that Ψ reconstructed.
    """

    @property
    def held(self) -> HeldViews:
        """Views in which recolouring keeps the colours; there are none, so that none changes."""
        return HeldViews(torch.empty(0, 3), torch.empty(0, 0), torch.empty(0))

    def compute_alpha(self, frozen: FrozenScene, camera: Camera) -> Float[Tensor, "h w"]:
        """Render accumulated opacity with every Gaussian weighted by its trust."""
        return frozen.render.alpha

    def accept(self, frozen: FrozenScene, camera: Camera, rows: Int64[Tensor, "r"]) -> Trust:
        """Trust recoloured rows, and hold all colours in the direction of a completed target."""
        return self

    def thin(self, rows: Int[Tensor, "r"], growth: Float[Tensor, "r"]) -> Trust:
        """Restrict to ascending rows that stand for their neighbours, each enlarged by a factor.

        `growth` is the factor of the lengths.
        """
        return self
