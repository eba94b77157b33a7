"""The sparse U-Net of VolSplat against the same network on a dense grid, as a ratio.

    python benchmarks/bench_sparse.py [--size 256] [--dense-cells 64]

No dense network can hold the published resolution, so both also run on coarser voxels in a box of
`dense_cells` cells a side.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
import torch.nn.functional as F
import tyro
from torch import Tensor

from gscompleter.models.feed_forward.sparse import Grid, SparseConv, build_hierarchy
from gscompleter.models.feed_forward.sparse_unet import SparseUNet
from gscompleter.models.feed_forward.voxels import voxelize

CHANNELS = 164
RESOLUTION = 0.001
"""Voxel size of the published model, in scene units."""


def measure_best_seconds(function: Callable[[], object], runs: int = 3) -> float:
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def make_points(size: int) -> Tensor:
    """Make a point per pixel of two adjacent cameras, on surfaces 2 to 6 units away."""
    place = (torch.arange(size) + 0.5) / size - 0.5
    y, x = torch.meshgrid(place, place, indexing="ij")
    rays = torch.stack([x, y, torch.full_like(x, 0.9)], dim=-1) / 0.9
    depth = 4 + 2 * torch.sin(6 * x) * torch.cos(5 * y)
    left, right = depth[..., None] * rays, 1.01 * depth[..., None] * rays
    return torch.cat([left.reshape(-1, 3), right.reshape(-1, 3) + torch.tensor([0.2, 0.0, 0.0])])


def convert_kernel(conv: SparseConv) -> Tensor:
    """Convert [27, in, out] with x fastest to [out, in, x, y, z]."""
    kernel = conv.kernel
    return kernel.unflatten(0, (3, 3, 3)).permute(4, 3, 2, 1, 0).contiguous()


def run_dense_unet(network: SparseUNet, features: Tensor) -> Tensor:
    """Run the convolutions of `network` on every cell of a box [1, c, x, y, z]."""
    x, encoded = features, []
    for encoder in network.encoders:
        x = F.conv3d(x, convert_kernel(encoder.conv), stride=2, padding=1).relu_()
        encoded.append(x)
    x = F.conv3d(x, convert_kernel(network.bottleneck[0].conv), stride=2, padding=1).relu_()
    x = F.conv3d(x, convert_kernel(network.bottleneck[1].conv), padding=1).relu_()
    for up, join in network.decoder_blocks:
        x = torch.cat([upsample_box(x, up.upconv), encoded.pop()], dim=1)
        x = F.conv3d(x, join.kernel.T[..., None, None, None])
    return upsample_box(x, network.final_upsample.upconv)


def upsample_box(features: Tensor, conv: SparseConv) -> Tensor:
    """Apply a transposed convolution of stride 2 to a box."""
    kernel = convert_kernel(conv).transpose(0, 1)
    return F.conv_transpose3d(features, kernel, stride=2, padding=1, output_padding=1).relu_()


def fill_box(features: Tensor, grid: Grid, cells: int) -> Tensor:
    """Place features in a box of zeros [1, c, cells, cells, cells]."""
    box = features.new_zeros((cells, cells, cells, features.shape[1]))
    x, y, z = (grid.coordinates - grid.coordinates.amin(dim=0))[:, 1:].unbind(1)
    box[x, y, z] = features
    return box.permute(3, 0, 1, 2)[None]


@torch.inference_mode()
def main(size: int = 256, dense_cells: int = 64) -> None:
    """Print the table.

    Args:
        size: Side of the two photographs in pixels.
        dense_cells: Side of the box of the dense network, a multiple of 16.
    """
    torch.manual_seed(0)
    points = make_points(size)
    features = torch.rand(len(points), CHANNELS)
    network = SparseUNet(CHANNELS).eval()

    fine = voxelize(points, features, RESOLUTION)
    tables = measure_best_seconds(lambda: build_hierarchy(fine.grid, 4))
    whole = measure_best_seconds(lambda: network(fine.features, fine.grid), runs=2)
    print(f"voxels of {RESOLUTION:g}: {len(fine.grid):,}")
    print(f"  tables of neighbours {tables:8.2f} s, {100 * tables / whole:.0f} % of the network")
    print(f"  sparse network       {whole:8.2f} s")

    extent = (points.amax(dim=0) - points.amin(dim=0)).max().item()
    coarse = voxelize(points, features, extent / (dense_cells - 2))
    sparse = measure_best_seconds(lambda: network(coarse.features, coarse.grid))
    box = fill_box(coarse.features, coarse.grid, dense_cells)
    dense = measure_best_seconds(lambda: run_dense_unet(network, box), runs=2)
    share = 100 * len(coarse.grid) / dense_cells**3
    print(f"a box of {dense_cells}³ cells, of which {len(coarse.grid):,} ({share:.1f} %) occupied")
    print(f"  sparse network       {sparse:8.2f} s")
    print(f"  dense network        {dense:8.2f} s, {dense / sparse:.1f} x the sparse one")


if __name__ == "__main__":
    tyro.cli(main)
