"""Sparse 3-D convolutions as MinkowskiEngine defines them.

A sparse tensor is a `Grid` of occupied cells and a matrix with one row of features per cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from gscompleter.system.errors import InputError

Offset = tuple[int, int, int]
OFFSETS: tuple[Offset, ...] = tuple((k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1) for k in range(27))
"""Offsets x, y, z of the 27 kernel matrices, in cells; x changes fastest."""


@dataclass(frozen=True)
class Packing:
    """A box of cells from `low`, `spans` cells wide, numbered in the order (batch, x, y, z)."""

    low: tuple[int, int, int]
    spans: tuple[int, int, int]

    @staticmethod
    def enclose(cells: Int64[Tensor, "n 4"]) -> Packing:
        """Enclose `cells` in a box with a border of one cell for their neighbours."""
        if len(cells) == 0:
            raise InputError("A sparse grid has no cells; it needs at least one.")
        low = cells.amin(0).tolist()
        high = cells.amax(0).tolist()
        if low[0] < 0:
            raise InputError(f"Batch numbers of a sparse grid start at 0; one is {low[0]}.")
        # One cell for the difference, and the border of one on both sides.
        x, y, z = (last - first + 3 for first, last in zip(low[1:], high[1:], strict=True))
        if (high[0] + 1) * x * y * z >= 2**63:
            raise InputError(
                f"The voxels span {x:,} x {y:,} x {z:,} cells, which 64-bit numbers cannot count; "
                "use larger voxels or a smaller far plane."
            )
        return Packing((low[1] - 1, low[2] - 1, low[3] - 1), (x, y, z))

    def number_cells(self, cells: Int64[Tensor, "n 4"]) -> Int64[Tensor, "n"]:
        """Compute the number of each cell (batch, x, y, z)."""
        # As digits of a number with the spans as bases: sorted numbers are sorted rows.
        batch, x, y, z = cells.unbind(1)
        key = batch * self.spans[0] + (x - self.low[0])
        key = key * self.spans[1] + (y - self.low[1])
        return key * self.spans[2] + (z - self.low[2])

    def compute_step(self, offset: Offset) -> int:
        """Compute the difference of numbers that corresponds to an offset in cells."""
        x, y, z = offset
        return (x * self.spans[1] + y) * self.spans[2] + z


@dataclass(frozen=True)
class Grid:
    """The occupied cells of a grid, one per row of a sparse tensor."""

    coordinates: Int64[Tensor, "n 4"]
    """Batch, x, y and z in units of the finest grid; rows are unique and ascending."""
    stride: int = 1
    """Side length of a cell in units of the finest grid; it divides all x, y and z."""

    def __len__(self) -> int:
        return len(self.coordinates)

    @cached_property
    def packing(self) -> Packing:
        """The numbering of the cells of this grid."""
        return Packing.enclose(self._to_cells(self.coordinates))

    def number_coordinates(self, coordinates: Int64[Tensor, "m 4"]) -> Int64[Tensor, "m"]:
        """Compute the numbers of cells in or next to this grid, occupied or not."""
        return self.packing.number_cells(self._to_cells(coordinates))

    @cached_property
    def keys(self) -> Int64[Tensor, "n"]:
        """The number of each row, ascending."""
        keys = self.number_coordinates(self.coordinates)
        if not (keys[1:] > keys[:-1]).all():
            raise ValueError("the rows of a grid must be unique and in ascending order")
        return keys

    def find(
        self, keys: Int64[Tensor, "m"]
    ) -> tuple[Int64[Tensor, "found"], Int64[Tensor, "found"]]:
        """Return the indices of `keys` that are cells of this grid, and the rows of those cells."""
        # Keys are sorted: a binary search finds the only row that a key can be in.
        rows = torch.searchsorted(self.keys, keys).clamp_max(len(self) - 1)
        hits = (self.keys[rows] == keys).nonzero()[:, 0]
        return hits, rows[hits]

    def coarsen(self) -> Grid:
        """Merge the cells into cells of twice the side length."""
        stride = 2 * self.stride
        parents = self.coordinates.clone()
        # Negative cells round down too, so that all cells have the same size.
        parents[:, 1:] = parents[:, 1:].div(stride, rounding_mode="floor") * stride
        return Grid(unique_rows(parents)[0], stride)

    def _to_cells(self, coordinates: Int64[Tensor, "m 4"]) -> Int64[Tensor, "m 4"]:
        batch = coordinates[:, :1]
        position = coordinates[:, 1:]
        return torch.cat([batch, position.div(self.stride, rounding_mode="floor")], dim=1)


def unique_rows(
    coordinates: Int64[Tensor, "n 4"],
) -> tuple[Int64[Tensor, "m 4"], Int64[Tensor, "n"]]:
    """Return the unique rows (batch, x, y, z), ascending, and the index of each row in them."""
    keys = Packing.enclose(coordinates).number_cells(coordinates)
    unique, inverse = torch.unique(keys, return_inverse=True)
    rows = coordinates.new_empty((len(unique), 4))
    # Any of the equal rows may be written last.
    rows[inverse] = coordinates
    return rows, inverse


@dataclass(frozen=True)
class Neighbours:
    """Pairs of input (source) and output (target) rows for each of the 27 kernel offsets."""

    sources: tuple[Int64[Tensor, "_"], ...]
    targets: tuple[Int64[Tensor, "_"], ...]
    num_sources: int
    num_targets: int

    def transpose_pairs(self) -> Neighbours:
        """Swap input and output, for the transposed convolution."""
        return Neighbours(self.targets, self.sources, self.num_targets, self.num_sources)


def find_neighbours_within(grid: Grid) -> Neighbours:
    """Find the pairs of a convolution of stride 1."""
    # If `b` is at an offset from `a`, `a` is at the opposite offset from `b`: 13 of 27 suffice.
    half = [grid.find(grid.keys + grid.packing.compute_step(offset)) for offset in OFFSETS[:13]]
    itself = torch.arange(len(grid), device=grid.coordinates.device)
    targets = [a for a, _ in half] + [itself] + [b for _, b in reversed(half)]
    sources = [b for _, b in half] + [itself] + [a for a, _ in reversed(half)]
    return Neighbours(tuple(sources), tuple(targets), len(grid), len(grid))


def find_neighbours_between(fine: Grid, coarse: Grid) -> Neighbours:
    """Find the pairs of a convolution of stride 2, centred on the lower corners of coarse cells."""
    if coarse.stride != 2 * fine.stride:
        raise ValueError(f"the coarse grid must have stride {2 * fine.stride}, not {coarse.stride}")
    odd = (fine.coordinates[:, 1:].div(fine.stride, rounding_mode="floor") & 1).bool()
    pairs = [_find_rows_at(offset, odd, fine, coarse) for offset in OFFSETS]
    sources, targets = zip(*pairs, strict=True)
    return Neighbours(sources, targets, len(fine), len(coarse))


def _find_rows_at(
    offset: Offset, odd: Bool[Tensor, "n 3"], fine: Grid, coarse: Grid
) -> tuple[Int64[Tensor, "m"], Int64[Tensor, "m"]]:
    """Find the pairs of fine and coarse rows at `offset` from the corner of the coarse cell."""
    # A coarse corner is even along all axes. At an offset from it lie the fine cells that are odd
    # along just those axes where the offset is not 0: only these are looked up.
    away = torch.tensor(offset, device=odd.device)
    rows = (odd == (away != 0)).all(dim=1).nonzero()[:, 0]
    corners = fine.coordinates[rows]
    corners[:, 1:] -= away * fine.stride
    found, targets = coarse.find(coarse.number_coordinates(corners))
    return rows[found], targets


def convolve(
    features: Float[Tensor, "n channels_in"],
    kernel: Float[Tensor, "27 channels_in channels_out"],
    neighbours: Neighbours,
) -> Float[Tensor, "m channels_out"]:
    """Sum the products of rows and kernel matrices, in a fixed order for reproducible results."""
    if len(features) != neighbours.num_sources:
        raise ValueError(f"the grid has {neighbours.num_sources} cells, not {len(features)}")
    output = features.new_zeros((neighbours.num_targets, kernel.shape[2]))
    # One offset after the other, and rows in their order: sums of floats depend on it.
    for sources, targets, matrix in zip(
        neighbours.sources, neighbours.targets, kernel, strict=True
    ):
        if len(sources) > 0:
            output.index_add_(0, targets, features[sources] @ matrix)
    return output


class SparseConv(nn.Module):
    """A 3x3x3 convolution without bias; its `Neighbours` define stride and direction."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        spread = (27 * channels_in) ** -0.5
        self.kernel = nn.Parameter(spread * torch.randn(27, channels_in, channels_out))

    def forward(
        self, features: Float[Tensor, "n channels_in"], neighbours: Neighbours
    ) -> Float[Tensor, "m channels_out"]:
        """Apply the convolution."""
        return convolve(features, self.kernel, neighbours)


class PointwiseConv(nn.Module):
    """A 1x1x1 convolution without bias."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        spread = channels_in**-0.5
        self.kernel = nn.Parameter(spread * torch.randn(channels_in, channels_out))

    def forward(self, features: Float[Tensor, "n channels_in"]) -> Float[Tensor, "n channels_out"]:
        """Apply the convolution."""
        return features @ self.kernel


def build_hierarchy(grid: Grid, num_levels: int) -> tuple[list[Neighbours], Neighbours]:
    """Find the pairs between `num_levels` halvings of `grid`, and those in the coarsest grid."""
    downward = []
    for _ in range(num_levels):
        coarse = grid.coarsen()
        downward.append(find_neighbours_between(grid, coarse))
        grid = coarse
    return downward, find_neighbours_within(grid)
