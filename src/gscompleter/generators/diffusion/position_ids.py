"""Where each latent token lies: PE-Field's positions on three levels.

A position is a triple (z, row, column), rows and columns in units of the target's tokens. A token
has one triple on level 0, one for each of its 2 x 2 cells on level 1, and one for each of its
4 x 4 cells on level 2: 1 + 4 + 16 triples, kept as one row of 63 numbers.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.types import Camera

LEVELS = (1, 2, 4)
"""Cells that a side of a token is divided into, level by level."""
IDS = 3 * sum(factor**2 for factor in LEVELS)
"""Numbers for each token: 63."""
FLAT_DEPTH = 0.01
"""Normalised depth of a source image whose points all lie at one depth."""
CLOSEST = 1e-3
"""Least z-depth that a point is projected with, as a share of the median depth of all. What lies
behind the target camera is thereby projected far outside of its image."""


def target_ids(
    size: tuple[int, int], grid: tuple[int, int], dtype: torch.dtype = torch.bfloat16
) -> Float[Tensor, "tokens 63"]:
    """Positions of the tokens of the image that is generated, a regular grid at z = 0.

    Level 0 holds the plain integers of FLUX; level k the centres of the cells, in tokens.

    Args:
        size: Height and width of the generated image, in pixels.
        grid: Height and width in tokens.
        dtype: What the positions are rounded to before use. The authors' run rounds them to
            bfloat16, which moves level 2 by up to an eighth of a token at 1024 pixels.
    """
    levels = []
    for factor in LEVELS:
        rows, columns = (
            cell_centres(pixels, tokens, factor) for pixels, tokens in zip(size, grid, strict=True)
        )
        row, column = torch.meshgrid(rows, columns, indexing="ij")
        levels.append(packed(torch.stack([torch.zeros_like(row), row, column], dim=-1), factor))
    return torch.cat(levels, dim=-1).to(dtype).float()


def cell_centres(pixels: int, tokens: int, factor: int) -> Float[Tensor, "cells"]:
    """Centres of `factor` cells for each of `tokens` along a side, in tokens; -0.5 is the border.

    Computed as the authors do, from pixel centres, so that rounding falls the same way.
    """
    centres = torch.arange(pixels, dtype=torch.float32) + 0.5
    resized = torch.nn.functional.interpolate(
        centres[None, None, None], (1, tokens * factor), mode="bilinear", align_corners=False
    )
    return resized[0, 0, 0] / pixels * tokens - 0.5


def source_ids(
    depth: Float[Tensor, "h w"],
    source: Camera,
    target: Camera,
    source_grid: tuple[int, int],
    target_grid: tuple[int, int],
) -> Float[Tensor, "tokens 63"]:
    """Positions of the tokens of the photograph: where the target camera sees what they show.

    Every pixel is carried into the target camera through its depth; a token takes the mean of the
    two by two pixels around its centre (and so do its cells). z is normalised to [1, 2].

    With equal cameras, a token of 16 pixels that the target would number i gets i + 0.46875:
    the authors count from the centre of the first pixel of the image here, and from the centre
    of the first token for the target. The model was trained that way, and so it stays.

    Args:
        depth: z-depth of the photograph in scene units, positive everywhere.
        source: Its camera, of the size of `depth`.
        target: The camera of the image that is generated.
        source_grid: Height and width of the photograph in tokens.
        target_grid: Height and width of the generated image in tokens.
    """
    pixels, z = seen_from(depth, source, target)
    nearness = z - z.min()
    spread = nearness.max()
    if spread <= 1e-6 * depth.abs().max():
        nearness = torch.full_like(z, FLAT_DEPTH)
    else:
        nearness = nearness / spread
    positions = torch.stack([nearness + 1, pixels[..., 1], pixels[..., 0]], dim=-1)

    in_tokens = positions.new_tensor(
        [1.0, target_grid[0] / target.height, target_grid[1] / target.width]
    )
    levels = []
    for factor in LEVELS:
        cells = (source_grid[0] * factor, source_grid[1] * factor)
        resized = torch.nn.functional.interpolate(
            positions.permute(2, 0, 1)[None], cells, mode="bilinear", align_corners=False
        )
        levels.append(packed(resized[0].permute(1, 2, 0) * in_tokens, factor))
    return torch.cat(levels, dim=-1)


def seen_from(
    depth: Float[Tensor, "h w"], source: Camera, target: Camera
) -> tuple[Float[Tensor, "h w 2"], Float[Tensor, "h w"]]:
    """Column and row of each pixel of `source` in `target`, and its z-depth there.

    Columns and rows are indices of pixels: 0 is the centre of the first one.
    """
    target_from_source = target.viewmat.double() @ source.c2w.double()
    K_source, K_target = source.K.double(), target.K.double()
    y, x = torch.meshgrid(
        torch.arange(depth.shape[0], dtype=torch.float64, device=depth.device),
        torch.arange(depth.shape[1], dtype=torch.float64, device=depth.device),
        indexing="ij",
    )
    index = torch.stack([x + 0.5, y + 0.5, torch.ones_like(x)], dim=-1)
    points = index @ torch.linalg.inv(K_source).T * depth.double()[..., None]
    moved = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    z = moved[..., 2]
    homogeneous = moved @ K_target.T
    in_front = z.clamp_min(CLOSEST * float(depth.median()))
    pixels = homogeneous[..., :2] - K_target[:2, 2] * z[..., None]
    pixels = pixels / in_front[..., None] + K_target[:2, 2] - 0.5
    return pixels.float(), z.float()


def packed(cells: Float[Tensor, "rows columns 3"], factor: int) -> Float[Tensor, "tokens numbers"]:
    """The triples of the `factor` x `factor` cells of each token, side by side.

    Two by two cells are gathered at a time, row by row, so that the quarters of a token come one
    after the other and each is followed through all its own quarters.
    """
    rows, columns = cells.shape[0], cells.shape[1]
    gathered = cells
    while factor > 1:
        rows, columns, factor = rows // 2, columns // 2, factor // 2
        gathered = (
            gathered.reshape(rows, 2, columns, 2, -1)
            .permute(0, 2, 1, 3, 4)
            .reshape(rows, columns, -1)
        )
    return gathered.reshape(rows * columns, -1)
