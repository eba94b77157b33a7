"""The DINOv2 vision transformer (Oquab et al. 2023), whose features DepthSplat and VolSplat use.

Names of parameters and modules are the keys of the published weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

PATCH = 14
"""Side length of a patch, in pixels."""
GRID = 37
"""Patches along each side of the training images; position embeddings have this size."""


class PatchEmbedding(nn.Module):
    """One token per patch, in row-major order."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, channels, PATCH, PATCH)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n t c"]:
        """Embed the patches."""
        return self.proj(images).flatten(2).transpose(1, 2)


class Attention(nn.Module):
    """Self-attention among the tokens of an image."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, x: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        """Apply self-attention."""
        # One matrix for queries, keys and values, from [n, t, 3 * c] to three of the shape
        # [n, heads, t, c / heads].
        q, k, v = self.qkv(x).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Two linear layers with four times the channels between them."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(channels, 4 * channels)
        self.fc2 = nn.Linear(4 * channels, channels)

    def forward(self, x: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        """Apply both layers."""
        return self.fc2(F.gelu(self.fc1(x)))


class LayerScale(nn.Module):
    """A learned factor per channel, by which a residual branch is damped."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(channels))

    def forward(self, x: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        """Scale the channels."""
        return x * self.gamma


class Block(nn.Module):
    """A layer of the transformer: attention and MLP, each with a norm before and a residual."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels, eps=1e-6)
        self.attn = Attention(channels, heads)
        self.ls1 = LayerScale(channels)
        self.norm2 = nn.LayerNorm(channels, eps=1e-6)
        self.mlp = Mlp(channels)
        self.ls2 = LayerScale(channels)

    def forward(self, x: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        """Apply attention, then the MLP."""
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class DinoV2(nn.Module):
    """A vision transformer with patches of 14 x 14 pixels and one class token."""

    def __init__(self, channels: int, num_blocks: int, heads: int) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, channels))
        self.pos_embed = nn.Parameter(torch.zeros(1, GRID**2 + 1, channels))
        self.patch_embed = PatchEmbedding(channels)
        self.blocks = nn.ModuleList(Block(channels, heads) for _ in range(num_blocks))
        self.norm = nn.LayerNorm(channels, eps=1e-6)

    def forward(
        self, images: Float[Tensor, "n 3 h w"], blocks: Sequence[int]
    ) -> list[Float[Tensor, "n c p q"]]:
        """Compute a feature map after each of `blocks`, indices from 0 in ascending order.

        Maps have a value per patch (p = h / 14, q = w / 14), after the last norm. `images` have the
        mean and deviation of ImageNet taken out (`normalize_images`) and sides divisible by 14.
        """
        size = (images.shape[2] // PATCH, images.shape[3] // PATCH)
        class_token = self.cls_token.expand(len(images), -1, -1)
        tokens = torch.cat([class_token, self.patch_embed(images)], 1)
        tokens = tokens + resize_position_embeddings(self.pos_embed, *size)
        maps = []
        for i, block in enumerate(self.blocks):
            tokens = block(tokens)
            if i in blocks:
                # Without the class token, which stands for the whole image.
                maps.append(self.norm(tokens)[:, 1:].transpose(1, 2).unflatten(2, size))
        return maps


def resize_position_embeddings(
    stored: Float[Tensor, "1 s c"], rows: int, columns: int
) -> Float[Tensor, "1 t c"]:
    """Resize position embeddings of `GRID` x `GRID` patches to `rows` x `columns`.

    The first one is that of the class token. Scale factors are those of the published code, which
    adds 0.1 to the numbers of patches, so that rounding never loses one; without it the map would
    be sampled at other places, and features would differ.
    """
    if rows == columns == GRID:
        return stored
    # From tokens to a map, which is resized like an image; the class token keeps its embedding.
    grid = stored[:, 1:].transpose(1, 2).unflatten(2, (GRID, GRID))
    factors = ((rows + 0.1) / GRID, (columns + 0.1) / GRID)
    resized = F.interpolate(grid, scale_factor=factors, mode="bicubic")
    return torch.cat([stored[:, :1], resized.flatten(2).transpose(1, 2)], 1)
