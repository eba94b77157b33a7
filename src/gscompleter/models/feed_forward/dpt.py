"""The DPT head of DepthSplat, which fuses four transformer maps to full resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.feed_forward.resampling import resize_bilinear

VIT = "vit"
"""Name of the transformer's own map in a `Layout`."""
CHANNELS = {"cnn0": 64, "cnn1": 96, "cnn2": 128, "matching0": 128, "matching1": 64, "disparity": 1}
"""Channels of encoder maps (finest first), matching maps (coarsest first) and disparity."""
Layout = Sequence[Sequence[str]]
"""Names of the maps joined at 1/2, 1/4 and 1/8 resolution, in this order."""


def create_padded_conv3x3(channels: int, out: int) -> nn.Conv2d:
    """Create a 3x3 convolution that replicates the image border."""
    return nn.Conv2d(channels, out, 3, 1, 1, padding_mode="replicate")


def create_padded_conv_block(channels: int, width: int, out: int) -> nn.Sequential:
    """Create two such convolutions with a GELU between them."""
    return nn.Sequential(
        create_padded_conv3x3(channels, width), nn.GELU(), create_padded_conv3x3(width, out)
    )


class ResidualUnit(nn.Module):
    """Two convolutions of the rectified input, added to it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, 1, 1)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Apply the unit."""
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Coarsest(nn.Module):
    """Refinement of the coarsest map, resized to the next level."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        self.resConfUnit2 = ResidualUnit(channels)

    def forward(
        self, x: Float[Tensor, "n c h w"], size: tuple[int, int]
    ) -> Float[Tensor, "n c p q"]:
        """Refine `x` and resize it to `size`."""
        return self.out_conv(resize_bilinear(self.resConfUnit2(x), size))


class Fusion(Coarsest):
    """Fusion of a coarse map with a finer one."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels)
        self.resConfUnit1 = ResidualUnit(channels)

    def fuse(
        self,
        coarse: Float[Tensor, "n c h w"],
        fine: Float[Tensor, "n c h w"],
        size: tuple[int, int],
    ) -> Float[Tensor, "n c p q"]:
        """Add the fine map to the coarse one, refine and resize the sum to `size`."""
        return self(coarse + self.resConfUnit1(fine), size)


class Scratch(nn.Module):
    """Fusion of maps at 1/2, 1/4, 1/8 and 1/16 resolution, coarse to fine."""

    def __init__(self, widths: Sequence[int], features: int, out: nn.Module | None) -> None:
        super().__init__()
        # The names of the layers are those of the authors' files, here and below.
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
        """Fuse the four levels."""
        fusions = (self.refinenet1, self.refinenet2, self.refinenet3, self.refinenet4)
        return self.output_conv(fuse_levels(self.project_levels(pyramid), *fusions))

    def project_levels(
        self, pyramid: Sequence[Float[Tensor, "n _ _ _"]]
    ) -> list[Float[Tensor, "n c _ _"]]:
        """Map all levels to the same number of channels."""
        layers = (self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn)
        return [layer(x) for layer, x in zip(layers, pyramid, strict=True)]


def fuse_levels(
    levels: Sequence[Float[Tensor, "n c _ _"]],
    finest: Fusion,
    finer: Fusion,
    coarser: Fusion,
    coarsest: Coarsest,
) -> Float[Tensor, "n c h w"]:
    """Fuse four levels, finest first, to twice the size of the finest."""
    # From the coarsest map up: each step refines what it has and resizes it to the next finer map.
    a, b, c, d = levels
    x = coarsest(d, get_map_size(c))
    x = coarser.fuse(x, c, get_map_size(b))
    x = finer.fuse(x, b, get_map_size(a))
    return finest.fuse(x, a, (2 * a.shape[2], 2 * a.shape[3]))


def get_map_size(x: Float[Tensor, "n c h w"]) -> tuple[int, int]:
    """Return height and width of a map."""
    return x.shape[2], x.shape[3]


def create_projections(channels: int, widths: Sequence[int]) -> nn.ModuleList:
    """Create the layers from transformer channels to those of the four levels, finest first."""
    return nn.ModuleList(nn.Conv2d(channels, width, 1) for width in widths)


def create_resizers(widths: Sequence[int]) -> nn.ModuleList:
    """Create the layers to 4, 2, 1 and 1/2 times the resolution of the transformer maps."""
    return nn.ModuleList(
        [
            nn.ConvTranspose2d(widths[0], widths[0], 4, 4),
            nn.ConvTranspose2d(widths[1], widths[1], 2, 2),
            nn.Identity(),
            nn.Conv2d(widths[3], widths[3], 3, 2, 1),
        ]
    )


class DptHead(nn.Module):
    """Join the transformer maps with other features and fuse them."""

    def __init__(
        self,
        vit_channels: int,
        widths: Sequence[int],
        features: int,
        layout: Layout,
        out: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.layout = layout
        self.projects = create_projections(vit_channels, widths)
        self.resize_layers = create_resizers(widths)
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
        """Fuse four `vit_maps` at 1/8 resolution with `maps` at the resolution of their levels."""
        pyramid = [
            resize(project(x))
            for resize, project, x in zip(self.resize_layers, self.projects, vit_maps, strict=True)
        ]
        # Levels 1 to 3 are joined with other features; the coarsest one is the transformer's alone.
        for level, (names, join) in enumerate(zip(self.layout, self.concat_projects, strict=True)):
            joined = [pyramid[level] if name == VIT else maps[name] for name in names]
            pyramid[level] = join(torch.cat(joined, 1))
        return self.scratch(pyramid)
