"""Convolutions over the occupied cells of a 3-D grid, as MinkowskiEngine defines them.

A sparse tensor is a `Grid`, which says where its rows lie, and a matrix of features, one row per
cell. A convolution of side 3 has a matrix for each of its 27 offsets. Which rows meet at an offset
depends on the grids alone: `Neighbours` is that table, found once and used by every convolution
between the same grids, transposed ones too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from gscompleter.errors import InputError

Offset = tuple[int, int, int]
OFFSETS: tuple[Offset, ...] = tuple((k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1) for k in range(27))
"""x, y, z of each of the 27 matrices of a kernel, in cells; x runs fastest."""


@dataclass(frozen=True)
class Packing:
    """A box of cells, numbered so that the numbers sort as (batch, x, y, z) does."""

    low: tuple[int, int, int]
    """The least x, y and z of the box."""
    spans: tuple[int, int, int]
    """How many cells it has along x, y and z."""

    @staticmethod
    def around(cells: Int64[Tensor, "n 4"]) -> Packing:
        """The box of `cells`, one cell wider on every side: neighbours have numbers too.

        Raises:
            InputError: no cells, a negative batch, or a box too large for 64-bit numbers.
        """
        if len(cells) == 0:
            raise InputError("A sparse grid was given no cells; it needs at least one.")
        low, high = cells.amin(0).tolist(), cells.amax(0).tolist()
        if low[0] < 0:
            raise InputError(f"Batch numbers of a sparse grid start at 0; one is {low[0]}.")
        x, y, z = (b - a + 3 for a, b in zip(low[1:], high[1:], strict=True))
        if (high[0] + 1) * x * y * z >= 2**63:
            raise InputError(
                f"The voxels span {x:,} x {y:,} x {z:,} cells, which 64-bit numbers cannot count; "
                "use larger voxels or a smaller far plane."
            )
        return Packing((low[1] - 1, low[2] - 1, low[3] - 1), (x, y, z))

    def keys(self, cells: Int64[Tensor, "n 4"]) -> Int64[Tensor, "n"]:
        """The number of each cell (batch, x, y, z)."""
        batch, x, y, z = cells.unbind(1)
        key = batch * self.spans[0] + (x - self.low[0])
        key = key * self.spans[1] + (y - self.low[1])
        return key * self.spans[2] + (z - self.low[2])

    def step(self, offset: Offset) -> int:
        """What an offset in cells adds to a number."""
        x, y, z = offset
        return (x * self.spans[1] + y) * self.spans[2] + z


@dataclass(frozen=True)
class Grid:
    """The occupied cells of a grid, which are the rows of a sparse tensor."""

    coordinates: Int64[Tensor, "n 4"]
    """Batch, x, y and z in units of the finest grid; rows are unique and in ascending order."""
    stride: int = 1
    """Side of a cell in units of the finest grid; every x, y and z is a multiple of it."""

    def __len__(self) -> int:
        return len(self.coordinates)

    @cached_property
    def packing(self) -> Packing:
        """Numbers for the cells of this grid."""
        return Packing.around(self._cells(self.coordinates))

    def keys_of(self, coordinates: Int64[Tensor, "m 4"]) -> Int64[Tensor, "m"]:
        """The numbers of cells of this grid or beside one, occupied or not."""
        return self.packing.keys(self._cells(coordinates))

    @cached_property
    def keys(self) -> Int64[Tensor, "n"]:
        """The number of each row, ascending.

        Raises:
            InputError: as `Packing.around` does.
            ValueError: rows that are not unique or not in order.
        """
        keys = self.keys_of(self.coordinates)
        if not (keys[1:] > keys[:-1]).all():
            raise ValueError("the rows of a grid must be unique and in ascending order")
        return keys

    def find(
        self, keys: Int64[Tensor, "m"]
    ) -> tuple[Int64[Tensor, "found"], Int64[Tensor, "found"]]:
        """Which of `keys` are cells of this grid, and the rows of those cells."""
        rows = torch.searchsorted(self.keys, keys).clamp_max(len(self) - 1)
        found = (self.keys[rows] == keys).nonzero()[:, 0]
        return found, rows[found]

    def coarser(self) -> Grid:
        """The cells of twice the side that hold those of this grid."""
        stride = 2 * self.stride
        parents = self.coordinates.clone()
        parents[:, 1:] = parents[:, 1:].div(stride, rounding_mode="floor") * stride
        return Grid(unique_rows(parents)[0], stride)

    def _cells(self, coordinates: Int64[Tensor, "m 4"]) -> Int64[Tensor, "m 4"]:
        """Coordinates in units of this grid."""
        batch, position = coordinates[:, :1], coordinates[:, 1:]
        return torch.cat([batch, position.div(self.stride, rounding_mode="floor")], dim=1)


def unique_rows(
    coordinates: Int64[Tensor, "n 4"],
) -> tuple[Int64[Tensor, "m 4"], Int64[Tensor, "n"]]:
    """The different rows (batch, x, y, z) in ascending order, and which of them each row is.

    Raises:
        InputError: as `Packing.around` does.
    """
    keys = Packing.around(coordinates).keys(coordinates)
    unique, inverse = torch.unique(keys, return_inverse=True)
    rows = coordinates.new_empty((len(unique), 4))
    rows[inverse] = coordinates
    return rows, inverse


@dataclass(frozen=True)
class Neighbours:
    """Which rows a convolution multiplies by each of its 27 matrices, and where it adds them."""

    sources: tuple[Int64[Tensor, "_"], ...]
    """For each offset, rows of the input."""
    targets: tuple[Int64[Tensor, "_"], ...]
    """For each offset, the row of the output each of these is added to, none of them twice."""
    num_sources: int
    """Rows of the input."""
    num_targets: int
    """Rows of the output."""

    def transposed(self) -> Neighbours:
        """The table of the transposed convolution, from the output's grid back to the input's."""
        return Neighbours(self.targets, self.sources, self.num_targets, self.num_sources)


def neighbours_within(grid: Grid) -> Neighbours:
    """The table of a convolution of stride 1: each cell gathers from those around it."""
    # If `a` finds `b` at an offset, `b` finds `a` at the opposite one: half of the 27 will do.
    half = [grid.find(grid.keys + grid.packing.step(offset)) for offset in OFFSETS[:13]]
    itself = torch.arange(len(grid), device=grid.coordinates.device)
    targets = [a for a, _ in half] + [itself] + [b for _, b in reversed(half)]
    sources = [b for _, b in half] + [itself] + [a for a, _ in reversed(half)]
    return Neighbours(tuple(sources), tuple(targets), len(grid), len(grid))


def neighbours_between(fine: Grid, coarse: Grid) -> Neighbours:
    """The table of a convolution of stride 2: a coarse cell gathers from around its corner.

    The corner of a coarse cell is its coordinate, so that a fine cell at an odd place along an
    axis lies one fine cell beside two corners, and one at an even place on a single one.
    """
    if coarse.stride != 2 * fine.stride:
        raise ValueError(f"the coarse grid must have stride {2 * fine.stride}, not {coarse.stride}")
    odd = (fine.coordinates[:, 1:].div(fine.stride, rounding_mode="floor") & 1).bool()
    pairs = [_rows_at(offset, odd, fine, coarse) for offset in OFFSETS]
    sources, targets = zip(*pairs, strict=True)
    return Neighbours(sources, targets, len(fine), len(coarse))


def _rows_at(
    offset: Offset, odd: Bool[Tensor, "n 3"], fine: Grid, coarse: Grid
) -> tuple[Int64[Tensor, "m"], Int64[Tensor, "m"]]:
    """The fine cells at `offset` from the corner of a coarse cell, and the coarse cells."""
    away = torch.tensor(offset, device=odd.device)
    rows = (odd == (away != 0)).all(dim=1).nonzero()[:, 0]
    corners = fine.coordinates[rows]
    corners[:, 1:] -= away * fine.stride
    found, targets = coarse.find(coarse.keys_of(corners))
    return rows[found], targets


def convolve(
    features: Float[Tensor, "n channels_in"],
    kernel: Float[Tensor, "27 channels_in channels_out"],
    neighbours: Neighbours,
) -> Float[Tensor, "m channels_out"]:
    """For each offset in turn: gather the rows, multiply by its matrix, add to the output.

    The sum at every cell has a fixed order, which makes it the same in every run.
    """
    if len(features) != neighbours.num_sources:
        raise ValueError(f"the grid has {neighbours.num_sources} cells, not {len(features)}")
    output = features.new_zeros((neighbours.num_targets, kernel.shape[2]))
    for sources, targets, matrix in zip(
        neighbours.sources, neighbours.targets, kernel, strict=True
    ):
        if len(sources) > 0:
            output.index_add_(0, targets, features[sources] @ matrix)
    return output


class SparseConv(nn.Module):
    """A convolution of side 3 without a bias; its table decides the stride and the direction."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        spread = (27 * channels_in) ** -0.5
        self.kernel = nn.Parameter(spread * torch.randn(27, channels_in, channels_out))

    def forward(
        self, features: Float[Tensor, "n channels_in"], neighbours: Neighbours
    ) -> Float[Tensor, "m channels_out"]:
        return convolve(features, self.kernel, neighbours)


class PointwiseConv(nn.Module):
    """A convolution of side 1 without a bias: one matrix for every cell."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        spread = channels_in**-0.5
        self.kernel = nn.Parameter(spread * torch.randn(channels_in, channels_out))

    def forward(self, features: Float[Tensor, "n channels_in"]) -> Float[Tensor, "n channels_out"]:
        return features @ self.kernel


def hierarchy_over(grid: Grid, num_levels: int) -> tuple[list[Neighbours], Neighbours]:
    """The tables of a U-Net of `num_levels` halvings of `grid`, and that within the coarsest grid.

    Each leads from a grid to the one of twice the stride; transposed, it leads up again.
    """
    downward = []
    for _ in range(num_levels):
        coarse = grid.coarser()
        downward.append(neighbours_between(grid, coarse))
        grid = coarse
    return downward, neighbours_within(grid)
