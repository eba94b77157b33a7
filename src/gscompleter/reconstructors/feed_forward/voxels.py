"""Points with features gathered into voxels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.reconstructors.feed_forward.sparse import Grid, unique_rows


@dataclass(frozen=True)
class Voxels:
    """The occupied voxels of a cloud of points, in the order of their coordinates."""

    grid: Grid
    """Coordinates of the voxels: those of their centres, in units of the resolution."""
    points: Float[Tensor, "n 3"]
    """Mean of the points of each voxel."""
    features: Float[Tensor, "n c"]
    """Mean of their features."""


def voxelize(
    points: Float[Tensor, "p 3"], features: Float[Tensor, "p c"], resolution: float
) -> Voxels:
    """The voxels of side `resolution`, in the unit of `points`, that hold a point.

    Raises:
        InputError: a resolution that is not positive, no points, points that are not finite, or
            so far apart that their voxels cannot be counted.
    """
    if not resolution > 0:
        raise InputError(f"The side of a voxel is {resolution:g}; it must be positive.")
    if not (points.abs() < resolution * 2.0**62).all():
        raise InputError(
            "Some points to voxelize are not finite, or farther away than 64-bit numbers count; "
            "check poses and depth range."
        )
    # Halves are rounded to even, as the published models were trained.
    coordinates = torch.round(points / resolution).long()
    rows, voxel = unique_rows(torch.nn.functional.pad(coordinates, (1, 0)))
    return Voxels(
        Grid(rows), mean_rows(points, voxel, len(rows)), mean_rows(features, voxel, len(rows))
    )


def mean_rows(
    rows: Float[Tensor, "p c"], group: Int64[Tensor, "p"], num_groups: int
) -> Float[Tensor, "groups c"]:
    """The mean of the rows of each group; every group has one."""
    total = rows.new_zeros((num_groups, rows.shape[1])).index_add_(0, group, rows)
    return total / group.bincount(minlength=num_groups)[:, None]
