"""The DPT head of DepthSplat: four maps of a vision transformer, fused to full resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.reconstructors.feed_forward.resampling import resized

VIT = "vit"
"""Stands, among the names of maps that are joined, for the transformer's own."""
CHANNELS = {"cnn0": 64, "cnn1": 96, "cnn2": 128, "matching0": 128, "matching1": 64, "disparity": 1}
"""Of the maps they are joined with: of the encoder (finest first), of the multi-view transformer
(coarsest first), and the inverse depth."""
Layout = Sequence[Sequence[str]]
"""Names of the maps that are joined at 1/2, 1/4 and 1/8 of full resolution, in this order."""


def padded_conv3x3(channels: int, out: int) -> nn.Conv2d:
    """A convolution that continues the border."""
    return nn.Conv2d(channels, out, 3, 1, 1, padding_mode="replicate")


def two_padded_convolutions(channels: int, width: int, out: int) -> nn.Sequential:
    return nn.Sequential(padded_conv3x3(channels, width), nn.GELU(), padded_conv3x3(width, out))


class ResidualUnit(nn.Module):
    """Two convolutions of what is positive, added to the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, 1, 1)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Coarsest(nn.Module):
    """Refines the coarsest map and brings it to the size of the next."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        self.resConfUnit2 = ResidualUnit(channels)

    def forward(
        self, x: Float[Tensor, "n c h w"], size: tuple[int, int]
    ) -> Float[Tensor, "n c p q"]:
        return self.out_conv(resized(self.resConfUnit2(x), size))


class Fusion(Coarsest):
    """Adds a finer map, then does the same."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels)
        self.resConfUnit1 = ResidualUnit(channels)

    def fused(
        self,
        coarse: Float[Tensor, "n c h w"],
        fine: Float[Tensor, "n c h w"],
        size: tuple[int, int],
    ) -> Float[Tensor, "n c p q"]:
        return self(coarse + self.resConfUnit1(fine), size)


class Scratch(nn.Module):
    """Fuses maps at 1/2, 1/4, 1/8 and 1/16 of full resolution, coarse to fine."""

    def __init__(self, widths: Sequence[int], features: int, out: nn.Module | None) -> None:
        super().__init__()
        self.layer1_rn = nn.Conv2d(widths[0], features, 3, 1, 1, bias=False)
        self.layer2_rn = nn.Conv2d(widths[1], features, 3, 1, 1, bias=False)
        self.layer3_rn = nn.Conv2d(widths[2], features, 3, 1, 1, bias=False)
        self.layer4_rn = nn.Conv2d(widths[3], features, 3, 1, 1, bias=False)
        self.refinenet1 = Fusion(features)
        self.refinenet2 = Fusion(features)
        self.refinenet3 = Fusion(features)
        self.refinenet4 = Coarsest(features)
        self.output_conv = nn.Identity() if out is None else out

    def forward(self, pyramid: Sequence[Float[Tensor, "n _ _ _"]]) -> Float[Tensor, "n c h w"]:
        fusions = (self.refinenet1, self.refinenet2, self.refinenet3, self.refinenet4)
        return self.output_conv(fused(self.levels(pyramid), *fusions))

    def levels(self, pyramid: Sequence[Float[Tensor, "n _ _ _"]]) -> list[Float[Tensor, "n c _ _"]]:
        """The maps of all levels, with the same number of channels."""
        layers = (self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn)
        return [layer(x) for layer, x in zip(layers, pyramid, strict=True)]


def fused(
    levels: Sequence[Float[Tensor, "n c _ _"]],
    finest: Fusion,
    finer: Fusion,
    coarser: Fusion,
    coarsest: Coarsest,
) -> Float[Tensor, "n c h w"]:
    """Four levels, finest first, fused to twice the size of the finest."""
    a, b, c, d = levels
    x = coarsest(d, size_of(c))
    x = coarser.fused(x, c, size_of(b))
    x = finer.fused(x, b, size_of(a))
    return finest.fused(x, a, (2 * a.shape[2], 2 * a.shape[3]))


def size_of(x: Float[Tensor, "n c h w"]) -> tuple[int, int]:
    """Height and width of a map."""
    return x.shape[2], x.shape[3]


def projections(channels: int, widths: Sequence[int]) -> nn.ModuleList:
    """From the maps of a transformer to the channels of the four levels, finest first."""
    return nn.ModuleList(nn.Conv2d(channels, width, 1) for width in widths)


def resizers(widths: Sequence[int]) -> nn.ModuleList:
    """To 4, 2, 1 and 1/2 times the resolution of the transformer's maps."""
    return nn.ModuleList(
        [
            nn.ConvTranspose2d(widths[0], widths[0], 4, 4),
            nn.ConvTranspose2d(widths[1], widths[1], 2, 2),
            nn.Identity(),
            nn.Conv2d(widths[3], widths[3], 3, 2, 1),
        ]
    )


class DptHead(nn.Module):
    """Joins the transformer's maps with others, and fuses them."""

    def __init__(
        self,
        vit_channels: int,
        widths: Sequence[int],
        features: int,
        layout: Layout,
        out: nn.Module | None = None,
    ) -> None:
        """
        Args:
            vit_channels: Of the maps of the vision transformer.
            widths: Channels of the four levels, finest first.
            features: Channels of the fused map.
            layout: Which maps are joined at the three finest levels.
            out: What follows the fusion, if anything does.
        """
        super().__init__()
        self.layout = layout
        self.projects = projections(vit_channels, widths)
        self.resize_layers = resizers(widths)
        self.concat_projects = nn.ModuleList(
            nn.Conv2d(sum(width if name == VIT else CHANNELS[name] for name in names), width, 1)
            for names, width in zip(layout, widths[:3], strict=True)
        )
        self.scratch = Scratch(widths, features, out)

    def forward(
        self,
        vit_maps: Sequence[Float[Tensor, "n c p q"]],
        maps: Mapping[str, Float[Tensor, "n _ _ _"]],
    ) -> Float[Tensor, "n o h w"]:
        """The fused map at full resolution.

        Args:
            vit_maps: Four, of all depths of the transformer, at 1/8 of full resolution.
            maps: The others, by name, at the resolution of the level that joins them.
        """
        pyramid = [
            resize(project(x))
            for resize, project, x in zip(self.resize_layers, self.projects, vit_maps, strict=True)
        ]
        for level, (names, join) in enumerate(zip(self.layout, self.concat_projects, strict=True)):
            joined = [pyramid[level] if name == VIT else maps[name] for name in names]
            pyramid[level] = join(torch.cat(joined, 1))
        return self.scratch(pyramid)
