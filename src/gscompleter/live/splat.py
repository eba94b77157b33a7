"""Gaussians as the page draws them: of one colour from everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.geometry import rotations_from
from gscompleter.types import SH_C0, Gaussians

TINT = (1.0, 0.45, 0.9)
"""What colours are multiplied by where Gaussians are tinted."""


@dataclass(frozen=True)
class Splat:
    """n Gaussians in a unit of their own, in which half of them are larger than 1.

    The page has covariances in float16, whose smallest step would swallow those of a scene in
    kilometres.
    """

    centers: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    rgbs: Float[np.ndarray, "n 3"]
    """Colours in [0, 1]."""
    opacities: Float[np.ndarray, "n 1"]
    size: float
    """Their unit, in units of the scene."""


def splat_of(gaussians: Gaussians, tinted: bool = False) -> Splat:
    """What the page is given to draw `gaussians`, which are one or more."""
    gaussians = gaussians.to("cpu")
    size = gaussians.scales.amax(dim=1).median().item()
    axes = rotations_from(gaussians.quats) * (gaussians.scales / size)[:, None, :]
    rgbs = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1)
    tint = torch.tensor(TINT if tinted else (1.0, 1.0, 1.0))
    return Splat(
        (gaussians.means / size).numpy(),
        (axes @ axes.transpose(1, 2)).numpy(),
        (rgbs * tint).numpy(),
        gaussians.opacities[:, None].clamp(0, 1).numpy(),
        size,
    )
