"""The visible distance field of a scene: how far each point of a grid is before what cameras see.

Programs that complete geometry take such a field, and return one of what is hidden. It is the mean
of truncated distances along the view axes of the cameras (Curless and Levoy 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.geometry import is_inside, project, unproject
from gscompleter.types import Camera

FIELD_SIDE = 128
"""Voxels along the longest side of the box of what is seen; the grid has a margin around it."""
TRUNCATION = 4
"""Largest distance that is told, and margin of the grid, in voxels; nothing is known farther behind
a surface."""
BOX_SHARE = 0.01
"""Share of the seen points that the box leaves out at each end of an axis: a few far ones would
make the voxels large."""


@dataclass(frozen=True)
class VisibleField:
    """Distances on a grid of voxels, with the axes of the frame that the cameras are in."""

    distance: Float[np.ndarray, "x y z"]
    """Distance before the nearest surface, negative behind it, in scene units; at most `TRUNCATION`
    voxels, and that in free space. 0 where nothing is known."""
    is_seen: Bool[np.ndarray, "x y z"]
    """True where a camera tells: before a surface, or just behind it."""
    origin: Float[np.ndarray, "3"]
    """Centre of the first voxel, in the frame of the cameras."""
    voxel_size: float
    """Side of a voxel in scene units."""


def compute_visible_field(
    cameras: Sequence[Camera], depths: Sequence[Float[Tensor, "_ _"]]
) -> VisibleField | None:
    """Compute the field of what cameras see; `depths` are z-depths, 0 where they see nothing.

    The cameras are in float64, in one frame, and on the CPU as the depths are. None if they see
    nothing.
    """
    points = [
        unproject(depth, camera)[depth > 0] for depth, camera in zip(depths, cameras, strict=True)
    ]
    seen = torch.cat(points).double().numpy()
    if len(seen) == 0:
        return None
    low, high = np.quantile(seen, [BOX_SHARE, 1 - BOX_SHARE], axis=0)
    voxel_size = float((high - low).max()) / (FIELD_SIDE - 1) or 1.0
    # A margin as wide as distances are told, behind the last surface as well.
    origin = low - TRUNCATION * voxel_size
    shape = np.ceil((high - low) / voxel_size).astype(int) + 1 + 2 * TRUNCATION
    axes = [
        torch.from_numpy(start + voxel_size * np.arange(count))
        for start, count in zip(origin, shape, strict=True)
    ]
    centers = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)

    reach = TRUNCATION * voxel_size
    total = torch.zeros(centers.shape[:3], dtype=torch.float64)
    count = torch.zeros_like(total)
    for camera, depth in zip(cameras, depths, strict=True):
        pixels, z = project(centers, camera)
        inside = is_inside(pixels, z, camera)
        x, y = pixels[inside].long().unbind(-1)
        surface = torch.zeros_like(z)
        surface[inside] = depth.double()[y, x]
        before = surface - z
        tells = (surface > 0) & (before >= -reach)
        total += torch.where(tells, before.clamp(max=reach), 0.0)
        count += tells
    mean = total / count.clamp_min(1)
    return VisibleField(
        mean.float().numpy(), (count > 0).numpy(), np.asarray(origin, np.float64), voxel_size
    )
