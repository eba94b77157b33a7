"""The sparse U-Net that refines the features of VolSplat's voxels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.reconstructors.feed_forward.sparse import (
    Grid,
    Neighbours,
    PointwiseConv,
    SparseConv,
    hierarchy_over,
)

CHANNELS = (64, 128, 256, 512)
"""Widths of the levels, from twice the stride of the input to sixteen times."""


class RowNorm(nn.Module):
    """Batch normalisation with every cell as a sample."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bn = nn.BatchNorm1d(channels)

    def forward(self, features: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
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
        return F.relu(self.norm(self.conv(features, neighbours)))


class UpBlock(nn.Module):
    """Transposed convolution, normalisation, ReLU; `downward` is the table it goes back along."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.upconv = SparseConv(channels_in, channels_out)
        self.norm = RowNorm(channels_out)

    def forward(
        self, features: Float[Tensor, "m channels_in"], downward: Neighbours
    ) -> Float[Tensor, "n channels_out"]:
        return F.relu(self.norm(self.upconv(features, downward.transposed())))


class DecoderBlock(nn.ModuleList):
    """Up to the next grid, where the features of the encoder join."""

    def __init__(self, width: int) -> None:
        super().__init__([UpBlock(2 * width, width), PointwiseConv(2 * width, width)])

    def forward(
        self,
        features: Float[Tensor, "m channels_in"],
        downward: Neighbours,
        encoded: Float[Tensor, "n width"],
    ) -> Float[Tensor, "n width"]:
        up, join = self
        return join(torch.cat([up(features, downward), encoded], dim=1))


class SparseUNet(nn.Module):
    """Four halvings of the grid and four doublings, each joined with what the halving saw.

    The names of the modules are those of the published weights.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        a, b, c, d = CHANNELS
        self.encoders = nn.ModuleList([ConvBlock(channels, a), ConvBlock(a, b), ConvBlock(b, c)])
        self.bottleneck = nn.ModuleList([ConvBlock(c, d), ConvBlock(d, d)])
        self.decoder_blocks = nn.ModuleList([DecoderBlock(c), DecoderBlock(b), DecoderBlock(a)])
        self.final_upsample = UpBlock(a, channels)

    def forward(self, features: Float[Tensor, "n c"], grid: Grid) -> Float[Tensor, "n c"]:
        """Refined features of the cells of `grid`."""
        tables, coarsest = hierarchy_over(grid, len(CHANNELS))
        x, encoded = features, []
        for encoder, downward in zip(self.encoders, tables[:-1], strict=True):
            x = encoder(x, downward)
            encoded.append(x)
        x = self.bottleneck[0](x, tables[-1])
        x = self.bottleneck[1](x, coarsest)
        for decoder, downward in zip(self.decoder_blocks, tables[:0:-1], strict=True):
            x = decoder(x, downward, encoded.pop())
        return self.final_upsample(x, tables[0])
