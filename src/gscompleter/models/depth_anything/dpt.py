"""The common part of the heads: fusion of four patch maps to image resolution (DPT)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.depth_anything.vit import Tokens
from gscompleter.models.feed_forward.dpt import Scratch, create_projections, create_resizers

HIDDEN = 32
"""Channels before the last convolution of a head."""
POSITION_WEIGHT = 0.1
"""Weight of the position encoding of maps."""
POSITION_BASE = 100.0
"""Approximate ratio of the longest to the shortest wavelength of the position encoding."""


class Dpt(nn.Module):
    """Conversion of tokens to maps at 4, 2, 1 and 1/2 times the patch resolution.

    With `has_positions` the encoding of their place in the image is added to the maps.
    """

    def __init__(self, channels: int, widths: Sequence[int], has_positions: bool) -> None:
        super().__init__()
        self.has_positions = has_positions
        self.projects = create_projections(channels, widths)
        self.resize_layers = create_resizers(widths)

    def compute_pyramid(
        self, tokens: Sequence[Tokens], rows: int, columns: int
    ) -> list[Float[Tensor, "n _ _ _"]]:
        """Compute the map of each level, finest first, for n = b v views."""
        maps = []
        for level, project, resize in zip(tokens, self.projects, self.resize_layers, strict=True):
            # From tokens [b, v, rows * columns, c] to maps [b * v, c, rows, columns].
            patches = self.normalize_patches(level.patches).flatten(0, 1).transpose(1, 2)
            x = project(patches.unflatten(2, (rows, columns)))
            if self.has_positions:
                x = add_position_encoding(x, columns / rows)
            maps.append(resize(x))
        return maps

    def normalize_patches(self, patches: Float[Tensor, "b v p c"]) -> Float[Tensor, "b v p c"]:
        """Return the patches unchanged; a subclass may normalise them."""
        return patches


class ImageScratch(Scratch):
    """Fusion of the levels, and the layers of the output, which heads call after it.

    `output_conv1` is for the fused map, at 8 times the patch resolution. The head resizes its
    result to the image, and `output_conv2` is for that.
    """

    def __init__(self, widths: Sequence[int], features: int, out: int) -> None:
        super().__init__(widths, features, out=None)
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, 1, 1)
        self.output_conv2 = create_output_layers(features // 2, out)


def create_output_layers(channels: int, out: int) -> nn.Sequential:
    """Create the output layers of a head."""
    return nn.Sequential(nn.Conv2d(channels, HIDDEN, 3, 1, 1), nn.ReLU(), nn.Conv2d(HIDDEN, out, 1))


def add_position_encoding(x: Float[Tensor, "n c h w"], aspect: float) -> Float[Tensor, "n c h w"]:
    """Encode columns in the first half of the channels and rows in the second."""
    c, h, w = x.shape[1:]
    # Positions in a frame whose half diagonal is 1, so that they do not depend on the resolution
    # and an image that is not square keeps its proportions.
    diagonal = (aspect**2 + 1) ** 0.5
    columns = compute_cell_positions(w, aspect / diagonal)
    rows = compute_cell_positions(h, 1 / diagonal)
    across = compute_sinusoids(columns, c // 4).to(x.device)[:, None, :].expand(-1, h, -1)
    down = compute_sinusoids(rows, c // 4).to(x.device)[:, :, None].expand(-1, -1, w)
    return x + POSITION_WEIGHT * torch.cat([across, down])


def compute_cell_positions(count: int, extent: float) -> Float[Tensor, "count"]:
    """Compute the centres of `count` cells between -extent and extent."""
    last = extent * (count - 1) / count
    return torch.linspace(-last, last, count)


def compute_sinusoids(at: Float[Tensor, "m"], count: int) -> Float[Tensor, "k m"]:
    """Compute `count` sines of decreasing frequency, then their cosines."""
    # In float64 on the CPU: the GPU of a Mac has none.
    k = torch.arange(count, dtype=torch.float64)
    angles = (POSITION_BASE ** (-k / count))[:, None] * at.double()
    return torch.cat([angles.sin(), angles.cos()]).to(at.dtype)
