"""The U-Net of latent diffusion (Rombach et al., 2022) without time steps, refining maps of views.

The views of a scene attend to each other. MVSplat normalises after each convolution, DepthSplat
before it (`pre_norm`). Attributes are named as the keys of the published weights. Maps are of
n = b v images, the v `views` of a scene one after the other.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

HEAD = 32
"""Channels of an attention head, which divide those of a map with attention."""


def create_conv3x3(channels: int, out: int, stride: int = 1) -> nn.Conv2d:
    """Create a 3x3 convolution, padded with zeros so that stride 1 keeps the size."""
    return nn.Conv2d(channels, out, 3, stride, 1)


def create_group_norm(channels: int) -> nn.GroupNorm:
    """Create a norm over 8 groups of channels, whose number is a multiple of 8."""
    return nn.GroupNorm(8, channels)


class ResidualBlock(nn.Module):
    """Two convolutions, each with its norm and activation, added to the input."""

    def __init__(self, channels: int, out: int, pre_norm: bool) -> None:
        super().__init__()
        if pre_norm:
            self.in_layers = nn.Sequential(
                create_group_norm(channels), nn.SiLU(), create_conv3x3(channels, out)
            )
            # The dropout has no effect but keeps the indices in the keys of the weights.
            self.out_layers = nn.Sequential(
                create_group_norm(out), nn.SiLU(), nn.Dropout(0.0), create_conv3x3(out, out)
            )
        else:
            self.in_layers = nn.Sequential(
                create_conv3x3(channels, out), create_group_norm(out), nn.SiLU()
            )
            self.out_layers = nn.Sequential(
                create_conv3x3(out, out), create_group_norm(out), nn.SiLU()
            )
        self.skip_connection = nn.Identity() if channels == out else nn.Conv2d(channels, out, 1)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n o h w"]:
        """Apply the block."""
        return self.skip_connection(x) + self.out_layers(self.in_layers(x))


class ViewAttention(nn.Module):
    """Self-attention over the pixels of all views of a scene, added to the input."""

    def __init__(self, channels: int, pre_norm: bool) -> None:
        super().__init__()
        self.pre_norm = pre_norm
        self.norm = create_group_norm(channels)
        self.qkv = nn.Conv1d(channels, 3 * channels, 1)
        self.proj_out = nn.Conv1d(channels, channels, 1)

    def forward(self, x: Float[Tensor, "n c h w"], views: int) -> Float[Tensor, "n c h w"]:
        """Apply the attention; the norm treats each view separately."""
        y = self.norm(x) if self.pre_norm else x
        # n c h w -> b c (v h w): each pixel is a token, one view after the other.
        y = y.flatten(2).unflatten(0, (-1, views)).transpose(1, 2).flatten(2)
        y = self.proj_out(self.attend(self.qkv(y)))
        y = y.unflatten(2, (views, -1)).transpose(1, 2).reshape(x.shape)
        return x + (y if self.pre_norm else self.norm(y))

    def attend(self, qkv: Float[Tensor, "b three_c t"]) -> Float[Tensor, "b c t"]:
        """Attend among t tokens; the channels are q, k and v of the first head, then the next."""
        q, k, v = qkv.unflatten(1, (-1, 3, HEAD)).transpose(-1, -2).unbind(2)
        return F.scaled_dot_product_attention(q, k, v).transpose(-1, -2).flatten(1, 2)


class Downsample(nn.Module):
    """Convolution to half the resolution, rounded up."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.op = create_conv3x3(channels, channels, stride=2)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c p q"]:
        """Downsample the map."""
        return self.op(x)


class Upsample(nn.Module):
    """Convolution at twice the resolution."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = create_conv3x3(channels, channels)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c 2*h 2*w"]:
        """Upsample the map."""
        return self.conv(F.interpolate(x, scale_factor=2, mode="nearest"))


class Steps(nn.ModuleList):
    """A sequence that tells the number of views to those modules that need it."""

    def forward(self, x: Float[Tensor, "n c h w"], views: int) -> Float[Tensor, "n o p q"]:
        """Apply the modules in order."""
        for step in self:
            x = step(x, views) if isinstance(step, ViewAttention | UNet) else step(x)
        return x


def create_refiner(channels: int, width: int, unet: UNet) -> Steps:
    """Create layers from `channels` to `width` channels: a convolution, a U-Net, a convolution."""
    before = [create_conv3x3(channels, width), create_group_norm(width), nn.GELU()]
    return Steps([*before, unet, create_conv3x3(width, width)])


def create_conv_block(channels: int, width: int, out: int) -> nn.Sequential:
    """Create two 3x3 convolutions with a GELU between them."""
    return nn.Sequential(create_conv3x3(channels, width), nn.GELU(), create_conv3x3(width, out))


class UNet(nn.Module):
    """A U-Net of constant width, with attention at `attention_level` (0 is the finest)."""

    def __init__(self, channels: int, levels: int, attention_level: int, pre_norm: bool) -> None:
        super().__init__()

        def create_blocks(width: int, level: int) -> list[nn.Module]:
            residual = ResidualBlock(width, channels, pre_norm)
            if level != attention_level:
                return [residual]
            return [residual, ViewAttention(channels, pre_norm)]

        self.input_blocks = nn.ModuleList([Steps([create_conv3x3(channels, channels)])])
        for level in range(levels):
            self.input_blocks.append(Steps(create_blocks(channels, level)))
            if level < levels - 1:
                self.input_blocks.append(Steps([Downsample(channels)]))
        # In the place of the identity latent diffusion has attention, which keys count.
        self.middle_block = nn.Sequential(
            ResidualBlock(channels, channels, pre_norm),
            nn.Identity(),
            ResidualBlock(channels, channels, pre_norm),
        )
        # Two blocks for each level, as each has two maps to join on the way up.
        self.output_blocks = nn.ModuleList()
        for level in reversed(range(levels)):
            self.output_blocks.append(Steps(create_blocks(2 * channels, level)))
            upsample = [Upsample(channels)] if level > 0 else []
            self.output_blocks.append(Steps([*create_blocks(2 * channels, level), *upsample]))
        norm = create_group_norm(channels)
        conv = create_conv3x3(channels, channels)
        out = [norm, nn.SiLU(), conv] if pre_norm else [conv, norm, nn.SiLU()]
        self.out = nn.Sequential(*out)

    def forward(self, x: Float[Tensor, "n c h w"], views: int) -> Float[Tensor, "n c h w"]:
        """Refine maps whose sides are multiples of 2^(levels - 1)."""
        # Each map of the way down, deepest last, is joined to one of the way up.
        skipped = []
        for block in self.input_blocks:
            x = block(x, views)
            skipped.append(x)
        x = self.middle_block(x)
        for block in self.output_blocks:
            x = block(torch.cat([x, skipped.pop()], 1), views)
        return self.out(x)
