"""Sparse convolutions: against dense ones, and against the values MinkowskiEngine gives."""

import json

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from feed_forward_fixtures import rule_v1
from gscompleter import InputError
from gscompleter.models.feed_forward.sparse import (
    OFFSETS,
    Grid,
    convolve,
    find_neighbours_between,
    find_neighbours_within,
    unique_rows,
)
from gscompleter.models.feed_forward.sparse_unet import SparseUNet
from gscompleter.models.feed_forward.volsplat import GaussianHead
from gscompleter.models.feed_forward.voxels import voxelize
from parity import assert_close
from volsplat_fixtures import FIXTURES, with_sparse_rule

LOW, SIDE = -6, 12
"""The dense grid the sparse ones lie in: coordinates LOW to LOW + SIDE, on even corners."""


def random_grid(share: float = 0.15, seed: int = 0) -> Grid:
    """Create two scenes of voxels around the origin, with one isolated voxel."""
    generator = torch.Generator().manual_seed(seed)
    occupied = torch.rand(2, SIDE - 2, SIDE - 2, SIDE - 2, generator=generator) < share
    occupied[1, :4, :4, :4] = False
    occupied[1, 1, 1, 1] = True
    rows = occupied.nonzero()
    rows[:, 1:] += LOW + 1
    return Grid(rows)


def random(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def dense(features: torch.Tensor, grid: Grid) -> torch.Tensor:
    """Scatter the features into zeros of shape [2, c, SIDE, SIDE, SIDE]."""
    array = features.new_zeros((2, SIDE, SIDE, SIDE, features.shape[1]))
    batch, x, y, z = grid.coordinates.unbind(1)
    array[batch, x - LOW, y - LOW, z - LOW] = features
    return array.permute(0, 4, 1, 2, 3)


def at(array: torch.Tensor, grid: Grid) -> torch.Tensor:
    """Read `array`, which has the grid's stride, at the rows of the grid."""
    batch = grid.coordinates[:, 0]
    x, y, z = ((grid.coordinates[:, 1:] - LOW) // grid.stride).unbind(1)
    return array[batch, :, x, y, z]


def dense_kernel(kernel: torch.Tensor) -> torch.Tensor:
    """Convert a kernel [27, in, out] to torch's [out, in, x, y, z]."""
    array = kernel.new_zeros((kernel.shape[2], kernel.shape[1], 3, 3, 3))
    for (x, y, z), matrix in zip(OFFSETS, kernel, strict=True):
        array[:, :, x + 1, y + 1, z + 1] = matrix.T
    return array


def test_stride_1_is_the_dense_convolution_at_the_occupied_cells():
    grid, kernel = random_grid(), random(27, 4, 5, seed=2)
    features = random(len(grid), 4)
    expected = F.conv3d(dense(features, grid), dense_kernel(kernel), padding=1)
    found = convolve(features, kernel, find_neighbours_within(grid))
    assert torch.allclose(found, at(expected, grid), atol=1e-12)


def test_stride_2_is_the_dense_convolution_at_the_parents_of_the_occupied_cells():
    grid, kernel = random_grid(), random(27, 4, 5, seed=2)
    features = random(len(grid), 4)
    coarse = grid.coarsen()
    expected = F.conv3d(dense(features, grid), dense_kernel(kernel), padding=1, stride=2)
    found = convolve(features, kernel, find_neighbours_between(grid, coarse))
    assert torch.allclose(found, at(expected, coarse), atol=1e-12)


def test_the_transposed_convolution_spreads_each_coarse_cell_to_the_fine_ones_around_its_corner():
    grid, kernel = random_grid(), random(27, 4, 5, seed=2)
    coarse = grid.coarsen()
    features = random(len(coarse), 4)
    rows = {tuple(row): i for i, row in enumerate(grid.coordinates.tolist())}
    expected = random(len(grid), 5) * 0
    for (batch, x, y, z), feature in zip(coarse.coordinates.tolist(), features, strict=True):
        for (dx, dy, dz), matrix in zip(OFFSETS, kernel, strict=True):
            fine = rows.get((batch, x + dx, y + dy, z + dz))
            if fine is not None:
                expected[fine] += feature @ matrix
    found = convolve(features, kernel, find_neighbours_between(grid, coarse).transpose_pairs())
    assert torch.allclose(found, expected, atol=1e-12)


def test_the_transposed_convolution_is_the_adjoint():
    """<conv(a), b> = <a, transposed conv(b)> with the matrices transposed."""
    grid, kernel = random_grid(seed=3), random(27, 4, 5, seed=2)
    coarse = grid.coarsen()
    table = find_neighbours_between(grid, coarse)
    a, b = random(len(grid), 4, seed=4), random(len(coarse), 5, seed=5)
    there = (convolve(a, kernel, table) * b).sum()
    back = (a * convolve(b, kernel.transpose(1, 2), table.transpose_pairs())).sum()
    assert torch.allclose(there, back, rtol=1e-12)


def test_a_voxel_alone_meets_only_the_middle_matrix():
    grid, kernel = Grid(torch.tensor([[0, -7, 3, 1]])), random(27, 2, 3)
    assert [OFFSETS[13], OFFSETS[14], OFFSETS[16]] == [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    features = random(1, 2, seed=2)
    assert torch.equal(
        convolve(features, kernel, find_neighbours_within(grid)), features @ kernel[13]
    )


def test_an_odd_voxel_alone_meets_the_matrix_of_the_offset_from_its_corner():
    """-7 is one above its parent -8, 3 one above 2; 1 is one above 0: offset (1, 1, 1)."""
    grid = Grid(torch.tensor([[0, -7, 3, 1]]))
    coarse = grid.coarsen()
    assert coarse.coordinates.tolist() == [[0, -8, 2, 0]]
    assert coarse.coarsen().coordinates.tolist() == [[0, -8, 0, 0]]
    kernel, features = random(27, 2, 3), random(1, 2, seed=2)
    found = convolve(features, kernel, find_neighbours_between(grid, coarse))
    assert torch.equal(found, features @ kernel[OFFSETS.index((1, 1, 1))])


def test_cells_at_opposite_borders_are_no_neighbours():
    """Numbers of cells run on from one row of the box to the next; the margin keeps them apart."""
    grid = Grid(torch.tensor([[0, 0, 0, 5], [0, 0, 1, 0], [1, 0, 0, 0]]))
    table = find_neighbours_within(grid)
    assert sum(len(rows) for rows in table.sources) == 3


def test_scenes_of_one_batch_do_not_mix():
    grid, kernel = random_grid(), random(27, 4, 5, seed=2)
    features = random(len(grid), 4)
    whole = convolve(features, kernel, find_neighbours_within(grid))
    second = grid.coordinates[:, 0] == 1
    alone = convolve(
        features[second], kernel, find_neighbours_within(Grid(grid.coordinates[second]))
    )
    assert torch.allclose(whole[second], alone, atol=1e-12)


def test_coordinates_beyond_32_bits_are_exact():
    far = 2**40
    grid = Grid(torch.tensor([[0, far, -3, 0], [0, far, -2, 0], [0, far + 1, -2, 1]]))
    sources = find_neighbours_within(grid).sources
    assert len(sources[OFFSETS.index((0, 1, 0))]) == 1
    assert len(sources[OFFSETS.index((1, 0, 1))]) == 1
    assert len(sources[OFFSETS.index((1, 1, 1))]) == 1


def test_a_box_too_large_to_number_is_refused():
    corners = torch.tensor([[0, -(2**30), 0, 0], [0, 2**30, 2**30, 2**30]])
    with pytest.raises(InputError, match="larger voxels"):
        find_neighbours_within(Grid(corners))


def test_rows_out_of_order_or_twice_are_refused():
    for rows in ([[0, 1, 0, 0], [0, 0, 0, 0]], [[0, 1, 0, 0], [0, 1, 0, 0]]):
        with pytest.raises(ValueError, match="unique"):
            find_neighbours_within(Grid(torch.tensor(rows)))


def test_features_of_another_grid_are_refused():
    grid = random_grid()
    with pytest.raises(ValueError, match="cells"):
        convolve(random(3, 4), random(27, 4, 5), find_neighbours_within(grid))


def test_unique_rows_are_those_of_torch():
    rows = torch.randint(-3, 3, (200, 4), generator=torch.Generator().manual_seed(0))
    rows[:, 0] += 3
    expected, index = torch.unique(rows, dim=0, return_inverse=True)
    found, inverse = unique_rows(rows)
    assert torch.equal(found, expected)
    assert torch.equal(inverse, index)


def test_points_fall_to_the_nearest_voxel_and_halves_to_the_even_one():
    points = torch.tensor([[0.5, 1.5, -0.5], [0.4, 2.4, 0.1], [-1.6, 0.0, 0.0]])
    voxels = voxelize(2 * points, torch.tensor([[1.0], [3.0], [7.0]]), 2.0)
    assert voxels.grid.coordinates.tolist() == [[0, -2, 0, 0], [0, 0, 2, 0]]
    assert torch.allclose(voxels.features, torch.tensor([[7.0], [2.0]]))
    assert torch.allclose(voxels.points[1], torch.tensor([0.9, 3.9, -0.4]))


@pytest.mark.parametrize(
    ("points", "resolution", "sentence"),
    [
        (torch.zeros(0, 3), 0.1, "at least one"),
        (torch.tensor([[0.0, float("nan"), 0.0]]), 0.1, "not finite"),
        (torch.zeros(2, 3), 0.0, "must be positive"),
        (torch.tensor([[0.0, 0.0, 0.0], [1e9, 1e9, 1e9]]), 1e-3, "larger voxels"),
        (torch.tensor([[1e30, 0.0, 0.0]]), 1e-3, "64-bit"),
    ],
)
def test_clouds_that_cannot_be_voxelized_are_refused(points, resolution, sentence):
    with pytest.raises(InputError, match=sentence):
        voxelize(points, torch.zeros(len(points), 1), resolution)


@pytest.fixture(scope="module")
def small() -> dict[str, torch.Tensor]:
    with np.load(FIXTURES / "sparse_small.npz") as file:
        return {name: torch.from_numpy(file[name]) for name in file}


def test_single_convolutions_agree_with_minkowski_engine(small):
    grid = Grid(small["coords"].long())
    coarse = grid.coarsen()
    table = find_neighbours_between(grid, coarse)
    place = {tuple(row): i for i, row in enumerate(small["conv_s2_coords"].tolist())}
    order = [place[tuple(row)] for row in coarse.coordinates.tolist()]
    assert sorted(order) == list(range(len(place)))
    kernel = rule_v1("conv.kernel", torch.Size((27, 8, 6)))
    down = convolve(small["feats"], kernel, table)
    assert_close(down, small["conv_s2_out"][order], "conv_s2")
    kernel = rule_v1("up.kernel", torch.Size((27, 6, 4)))
    up = convolve(down, kernel, table.transpose_pairs())
    assert torch.equal(grid.coordinates, small["up_coords"].long())
    assert_close(up, small["up_out"], "up")


def test_the_u_net_agrees_with_minkowski_engine(small):
    network = with_sparse_rule(SparseUNet(8))
    keys = json.loads((FIXTURES / "sparse_small_keys.json").read_text())["unet"]
    assert {k: list(v.shape) for k, v in network.state_dict().items()} == {
        key: shape for key, (shape, _) in keys.items()
    }
    with torch.inference_mode():
        found = network(small["feats"], Grid(small["coords"].long()))
    assert_close(found, small["unet_out"], "unet")


def test_two_convolutions_over_one_table_agree_with_minkowski_engine(small):
    """The input of the head is the output of the U-Net."""
    head = with_sparse_rule(GaussianHead(8, 5))
    with torch.inference_mode():
        found = head(small["unet_out"], Grid(small["coords"].long()))
    assert_close(found, small["head_out"], "head")


def test_the_u_net_gives_the_same_bits_twice(small):
    network = SparseUNet(8).eval()
    grid = Grid(small["coords"].long())
    with torch.inference_mode():
        assert torch.equal(network(small["feats"], grid), network(small["feats"], grid))
