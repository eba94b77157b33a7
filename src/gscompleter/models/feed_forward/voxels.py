"""Averaging of point features in voxels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gscompleter.models.feed_forward.sparse import Grid, unique_rows
from gscompleter.system.errors import InputError


@dataclass(frozen=True)
class Voxels:
    """The occupied voxels of a point cloud, with mean point and mean features of each."""

    grid: Grid
    """Centres of the voxels, in units of the resolution."""
    points: Float[Tensor, "n 3"]
    features: Float[Tensor, "n c"]


def voxelize(
    points: Float[Tensor, "p 3"], features: Float[Tensor, "p c"], resolution: float
) -> Voxels:
    """Group points into voxels of side `resolution`, in the unit of `points`.

    Raises:
        InputError: Resolution not positive, or points missing, not finite, or too far apart.
    """
    if not resolution > 0:
        raise InputError(f"The side of a voxel is {resolution:g}; it must be positive.")
    if not (points.abs() < resolution * 2.0**62).all():
        raise InputError(
            "Some points to voxelize are not finite, or farther away than 64-bit numbers count; "
            "check poses and depth range."
        )
    # torch.round rounds halves to even, as in the training of the published models.
    coordinates = torch.round(points / resolution).long()
    rows, voxel = unique_rows(torch.nn.functional.pad(coordinates, (1, 0)))
    return Voxels(
        Grid(rows), average_rows(points, voxel, len(rows)), average_rows(features, voxel, len(rows))
    )


def average_rows(
    rows: Float[Tensor, "p c"], group: Int64[Tensor, "p"], num_groups: int
) -> Float[Tensor, "groups c"]:
    """Average the rows of each group; no group may be empty."""
    total = rows.new_zeros((num_groups, rows.shape[1])).index_add_(0, group, rows)
    return total / group.bincount(minlength=num_groups)[:, None]
