"""Gaussians in the form that the page renders: without view-dependent colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.geometry import quats_to_rotations
from gscompleter.types import SH_C0, Gaussians

TINT_FACTORS = (1.0, 0.45, 0.9)


@dataclass(frozen=True)
class PageSplat:
    """Gaussians in a unit of their own: the median of their largest scales.

    The page keeps covariances in float16, in which those of a scene in kilometres would vanish.
    """

    centers: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    rgbs: Float[np.ndarray, "n 3"]
    opacities: Float[np.ndarray, "n 1"]
    size: float
    """Length of the unit, in scene units."""


def make_page_splat(gaussians: Gaussians, tinted: bool = False) -> PageSplat:
    """Convert one or more Gaussians for the page."""
    gaussians = gaussians.to("cpu")
    size = gaussians.scales.amax(dim=1).median().item()
    axes = quats_to_rotations(gaussians.quats) * (gaussians.scales / size)[:, None, :]
    rgbs = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1)
    tint = torch.tensor(TINT_FACTORS if tinted else (1.0, 1.0, 1.0))
    return PageSplat(
        (gaussians.means / size).numpy(),
        (axes @ axes.transpose(1, 2)).numpy(),
        (rgbs * tint).numpy(),
        gaussians.opacities[:, None].clamp(0, 1).numpy(),
        size,
    )
