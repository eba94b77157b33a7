"""The sparse U-Net that refines VolSplat's voxel features."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.feed_forward.sparse import (
    Grid,
    Neighbours,
    PointwiseConv,
    SparseConv,
    build_hierarchy,
)

CHANNELS = (64, 128, 256, 512)
"""Channels of the levels, from 2 to 16 times the stride of the input."""


class RowNorm(nn.Module):
    """Batch normalisation with each cell as a sample."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bn = nn.BatchNorm1d(channels)

    def forward(self, features: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Normalise the features."""
        return self.bn(features)


class ConvBlock(nn.Module):
    """Convolution, normalisation, ReLU."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.conv = SparseConv(channels_in, channels_out)
        self.norm = RowNorm(channels_out)

    def forward(
        self, features: Float[Tensor, "n channels_in"], neighbours: Neighbours
    ) -> Float[Tensor, "m channels_out"]:
        """Apply the block."""
        return F.relu(self.norm(self.conv(features, neighbours)))


class UpBlock(nn.Module):
    """Transposed convolution, normalisation, ReLU."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.upconv = SparseConv(channels_in, channels_out)
        self.norm = RowNorm(channels_out)

    def forward(
        self, features: Float[Tensor, "m channels_in"], downward: Neighbours
    ) -> Float[Tensor, "n channels_out"]:
        """Apply the block along the transpose of `downward`."""
        # The same pairs of cells as on the way down, with source and target swapped.
        return F.relu(self.norm(self.upconv(features, downward.transpose_pairs())))


class DecoderBlock(nn.ModuleList):
    """Upsampling to the next grid, joined with the features of the encoder."""

    def __init__(self, width: int) -> None:
        super().__init__([UpBlock(2 * width, width), PointwiseConv(2 * width, width)])

    def forward(
        self,
        features: Float[Tensor, "m channels_in"],
        downward: Neighbours,
        encoded: Float[Tensor, "n width"],
    ) -> Float[Tensor, "n width"]:
        """Upsample `features` and join them with `encoded`."""
        up, join = self
        return join(torch.cat([up(features, downward), encoded], dim=1))


class SparseUNet(nn.Module):
    """Four halvings and four doublings of the grid, with skip connections."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        a, b, c, d = CHANNELS
        self.encoders = nn.ModuleList([ConvBlock(channels, a), ConvBlock(a, b), ConvBlock(b, c)])
        self.bottleneck = nn.ModuleList([ConvBlock(c, d), ConvBlock(d, d)])
        self.decoder_blocks = nn.ModuleList([DecoderBlock(c), DecoderBlock(b), DecoderBlock(a)])
        self.final_upsample = UpBlock(a, channels)

    def forward(self, features: Float[Tensor, "n c"], grid: Grid) -> Float[Tensor, "n c"]:
        """Refine the features of the cells of `grid`."""
        # Pairs of cells between neighbouring levels, finest first, and within the coarsest one.
        tables, coarsest = build_hierarchy(grid, len(CHANNELS))
        x = features
        encoded = []
        for encoder, downward in zip(self.encoders, tables[:-1], strict=True):
            x = encoder(x, downward)
            encoded.append(x)
        x = self.bottleneck[0](x, tables[-1])
        x = self.bottleneck[1](x, coarsest)
        # Back up through the same levels; the finest one has no skip connection.
        for decoder, downward in zip(self.decoder_blocks, tables[:0:-1], strict=True):
            x = decoder(x, downward, encoded.pop())
        return self.final_upsample(x, tables[0])
