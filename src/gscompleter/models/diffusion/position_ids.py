"""Position ids of PE-Field for latent tokens, on three levels.

A position is (z, row, column), in tokens of the target. Levels 0, 1 and 2 divide a token into 1,
4 and 16 cells, so its 21 positions form a row of 63 numbers.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.types import Camera

LEVELS = (1, 2, 4)
"""Number of cells along a side of a token, per level."""
IDS = 3 * sum(factor**2 for factor in LEVELS)
"""Numbers per token: 63."""
FLAT_DEPTH = 0.01
"""Normalised depth of a source image with constant depth."""
MIN_RELATIVE_DEPTH = 1e-3
"""Smallest z-depth for projection relative to the median; clamps points behind the camera."""


def compute_target_ids(
    size: tuple[int, int], grid: tuple[int, int], dtype: torch.dtype = torch.bfloat16
) -> Float[Tensor, "tokens 63"]:
    """Compute positions of the generated tokens: integers at level 0, else cell centres; z = 0.

    Args:
        size: Height and width of the generated image, in pixels.
        grid: Height and width in tokens.
        dtype: Rounding. The authors' bfloat16 moves level 2 by up to 1/8 token at 1024 pixels.
    """
    levels = []
    for factor in LEVELS:
        rows = compute_cell_centers(size[0], grid[0], factor)
        columns = compute_cell_centers(size[1], grid[1], factor)
        row, column = torch.meshgrid(rows, columns, indexing="ij")
        levels.append(pack_cells(torch.stack([torch.zeros_like(row), row, column], dim=-1), factor))
    return torch.cat(levels, dim=-1).to(dtype).float()


def compute_cell_centers(pixels: int, tokens: int, factor: int) -> Float[Tensor, "cells"]:
    """Compute the centres of `factor` cells per token along a side, in tokens, from -0.5."""
    # Interpolated from the pixel centres: the middle of a cell where cells divide the pixels.
    centres = torch.arange(pixels, dtype=torch.float32) + 0.5
    resized = torch.nn.functional.interpolate(
        centres[None, None, None], (1, tokens * factor), mode="bilinear", align_corners=False
    )
    return resized[0, 0, 0] / pixels * tokens - 0.5


def compute_source_ids(
    depth: Float[Tensor, "h w"],
    source: Camera,
    target: Camera,
    source_grid: tuple[int, int],
    target_grid: tuple[int, int],
) -> Float[Tensor, "tokens 63"]:
    """Compute the positions of the photograph's tokens in the target camera.

    Pixels are projected by their positive z-depth; cells average the 2 x 2 pixels at their centres.
    z is normalised to [1, 2]. As in training, equal cameras give an offset of 0.46875 for tokens of
    16 pixels. Both grids are height and width in tokens.
    """
    pixels, z = project_to_target(depth, source, target)
    # From 0 at the pixel that is nearest to the target camera to 1 at the farthest.
    relative_depth = z - z.min()
    spread = relative_depth.max()
    if spread <= 1e-6 * depth.abs().max():
        relative_depth = torch.full_like(z, FLAT_DEPTH)
    else:
        relative_depth = relative_depth / spread
    positions = torch.stack([relative_depth + 1, pixels[..., 1], pixels[..., 0]], dim=-1)

    # From pixels to tokens of the target; the first coordinate has no unit.
    in_tokens = positions.new_tensor(
        [1.0, target_grid[0] / target.height, target_grid[1] / target.width]
    )
    levels = []
    for factor in LEVELS:
        cells = (source_grid[0] * factor, source_grid[1] * factor)
        resized = torch.nn.functional.interpolate(
            positions.permute(2, 0, 1)[None], cells, mode="bilinear", align_corners=False
        )
        levels.append(pack_cells(resized[0].permute(1, 2, 0) * in_tokens, factor))
    return torch.cat(levels, dim=-1)


def project_to_target(
    depth: Float[Tensor, "h w"], source: Camera, target: Camera
) -> tuple[Float[Tensor, "h w 2"], Float[Tensor, "h w"]]:
    """Project the pixels of `source` to pixel indices (column, row) and z-depth in `target`."""
    target_from_source = target.viewmat.double() @ source.c2w.double()
    K_source = source.K.double()
    K_target = target.K.double()
    y, x = torch.meshgrid(
        torch.arange(depth.shape[0], dtype=torch.float64, device=depth.device),
        torch.arange(depth.shape[1], dtype=torch.float64, device=depth.device),
        indexing="ij",
    )
    # Unproject in the axes of the source, and move into those of the target.
    index = torch.stack([x + 0.5, y + 0.5, torch.ones_like(x)], dim=-1)
    points = index @ torch.linalg.inv(K_source).T * depth.double()[..., None]
    moved = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    z = moved[..., 2]
    # The principal point is added after the division, which `in_front` keeps finite: a point
    # behind the camera goes far outside, instead of to a place within the image.
    homogeneous = moved @ K_target.T
    in_front = z.clamp_min(MIN_RELATIVE_DEPTH * float(depth.median()))
    pixels = homogeneous[..., :2] - K_target[:2, 2] * z[..., None]
    pixels = pixels / in_front[..., None] + K_target[:2, 2] - 0.5
    return pixels.float(), z.float()


def pack_cells(
    cells: Float[Tensor, "rows columns 3"], factor: int
) -> Float[Tensor, "tokens numbers"]:
    """Join the positions of the `factor` x `factor` cells of each token, in quadtree order."""
    rows = cells.shape[0]
    columns = cells.shape[1]
    gathered = cells
    # Joining 2 × 2 neighbours again and again puts the cells of each quarter side by side.
    while factor > 1:
        rows = rows // 2
        columns = columns // 2
        factor = factor // 2
        gathered = (
            gathered.reshape(rows, 2, columns, 2, -1)
            .permute(0, 2, 1, 3, 4)
            .reshape(rows, columns, -1)
        )
    return gathered.reshape(rows * columns, -1)
