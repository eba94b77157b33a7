"""Stage 4: keep Gaussians in holes and refine their opacities only (paper, Sec. III-F)."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.config import HoleConfig
from gscompleter.geometry import project_mask
from gscompleter.types import Camera, Gaussians


def compute_hole_mask(
    alpha: Float[Tensor, "h w"], config: HoleConfig = HoleConfig()
) -> Bool[Tensor, "h w"]:
    """Return True where alpha is below the threshold, before dilation (paper, Eq. 12)."""
    return alpha < config.max_alpha


def filter_holes(
    registered: Gaussians,
    pixel_index: Int[Tensor, "n"] | None,
    mask: Bool[Tensor, "h w"],
    target: Camera,
) -> Gaussians:
    """Keep Gaussians inside `mask`, by their source pixel if known, otherwise by projection."""
    if pixel_index is not None:
        return registered[mask.flatten()[pixel_index]]
    return registered[project_mask(mask, registered, target)]
