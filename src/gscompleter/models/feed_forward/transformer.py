"""The multi-view transformer of MVSplat and DepthSplat, with window attention.

It is that of UniMatch (Xu et al., 2023), which takes its windows from Swin (Liu et al., 2021). In
the shapes, b scenes have v views each, which are n = b v feature maps with c channels. Every view
has s source views. A window has p pixels, and there are SPLITS² of them. Names of modules are those
of the published weights.
"""

from __future__ import annotations

from math import pi

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from gscompleter.models.feed_forward.cameras import select_sources

SPLITS = 2
"""Number of windows along each side of a feature map, whose sides it divides."""
MASKED = -100.0
"""Attention bias between pixels that must not attend to each other, as in Swin."""


class WindowAttention(nn.Module):
    """Attention of each pixel to the window that it lies in, in all source views; a single head."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.q_proj = nn.Linear(channels, channels, bias=False)
        self.k_proj = nn.Linear(channels, channels, bias=False)
        self.v_proj = nn.Linear(channels, channels, bias=False)
        self.merge = nn.Linear(channels, channels, bias=False)
        self.norm1 = nn.LayerNorm(channels)

    def forward(
        self,
        x: Float[Tensor, "n h w c"],
        sources: Float[Tensor, "n s h w c"],
        mask: Float[Tensor, "windows p p"] | None,
    ) -> Float[Tensor, "n h w c"]:
        """Attend from `x` to `sources`.

        With a `mask`, that of `create_shifted_window_mask`, windows are shifted by half their size.
        """
        # For shifted windows the maps are rolled by half a window, split, and rolled back.
        _, height, width, _ = x.shape
        shift = (0, 0) if mask is None else (height // SPLITS // 2, width // SPLITS // 2)
        back = (-shift[0], -shift[1])
        query = split_windows(self.q_proj(x[:, None].roll(back, (2, 3))))
        sources = sources.roll(back, (2, 3))
        key = split_windows(self.k_proj(sources))
        value = split_windows(self.v_proj(sources))
        # The keys are ordered pixel by pixel, but the mask is repeated view by view, as in the
        # training of the published models. It matters with two or more source views.
        bias = None if mask is None else mask.repeat(1, 1, sources.shape[1])
        attended = F.scaled_dot_product_attention(query, key, value, bias)
        merged = merge_windows(attended, height, width).roll(shift, (1, 2))
        return self.norm1(self.merge(merged))


class WindowAttentionAndMlp(WindowAttention):
    """Window attention followed by an MLP on its result and the input."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels)
        self.mlp = nn.Sequential(
            nn.Linear(2 * channels, 8 * channels, bias=False),
            nn.GELU(),
            nn.Linear(8 * channels, channels, bias=False),
        )
        self.norm2 = nn.LayerNorm(channels)

    def forward(
        self,
        x: Float[Tensor, "n h w c"],
        sources: Float[Tensor, "n s h w c"],
        mask: Float[Tensor, "windows p p"] | None,
    ) -> Float[Tensor, "n h w c"]:
        """Apply attention as `WindowAttention` does, then the MLP."""
        message = super().forward(x, sources, mask)
        return self.norm2(self.mlp(torch.cat([x, message], -1)))


class TransformerLayer(nn.Module):
    """Attention within each view, then to its source views."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.self_attn = WindowAttention(channels)
        self.cross_attn_ffn = WindowAttentionAndMlp(channels)

    def forward(
        self,
        x: Float[Tensor, "b v h w c"],
        sources: Int[Tensor, "b v s"],
        mask: Float[Tensor, "windows p p"] | None,
    ) -> Float[Tensor, "b v h w c"]:
        """Apply self-attention, then cross-attention to the views with the numbers `sources`."""
        source_maps = select_sources(x, sources).flatten(0, 1)
        own = x.flatten(0, 1)
        own = own + self.self_attn(own, own[:, None], mask)
        return (own + self.cross_attn_ffn(own, source_maps, mask)).view_as(x)


class MultiViewTransformer(nn.Module):
    """Layers of attention; every other one, from the second on, has shifted windows."""

    def __init__(self, channels: int = 128, num_layers: int = 6) -> None:
        super().__init__()
        self.layers = nn.ModuleList(TransformerLayer(channels) for _ in range(num_layers))

    def forward(
        self, features: Float[Tensor, "n c h w"], sources: Int[Tensor, "b v s"]
    ) -> Float[Tensor, "n c h w"]:
        """Enrich the features of each view with those of the views with the numbers `sources`."""
        x = (features + encode_window_positions(features)).unflatten(0, sources.shape[:2])
        x = x.permute(0, 1, 3, 4, 2)
        height, width = x.shape[2:4]
        mask = create_shifted_window_mask(height, width, features.device)
        for i, layer in enumerate(self.layers):
            x = layer(x, sources, mask if i % 2 else None)
        return x.permute(0, 1, 4, 2, 3).flatten(0, 1)


def split_windows(x: Float[Tensor, "n s h w c"]) -> Float[Tensor, "n windows k c"]:
    """Split maps into windows with k = p s rows; those of the s views of a pixel are adjacent."""
    x = x.unflatten(3, (SPLITS, -1)).unflatten(2, (SPLITS, -1))
    return x.permute(0, 2, 4, 3, 5, 1, 6).flatten(3, 5).flatten(1, 2)


def merge_windows(
    windows: Float[Tensor, "n windows p c"], height: int, width: int
) -> Float[Tensor, "n {height} {width} c"]:
    """Invert `split_windows` for a single view."""
    x = windows.unflatten(1, (SPLITS, SPLITS)).unflatten(3, (height // SPLITS, width // SPLITS))
    return x.permute(0, 1, 3, 2, 4, 5).flatten(3, 4).flatten(1, 2)


def create_shifted_window_mask(
    height: int, width: int, device: torch.device
) -> Float[Tensor, "windows p p"]:
    """Create the attention bias of shifted windows: MASKED between opposite image borders."""

    # Rolling brings opposite borders of the image into the last window of each side. Its half that
    # was there before and the half from the other border get numbers of their own. A window of one
    # pixel is not shifted, and all of its side gets the same number.
    def number_bands(size: int) -> Float[Tensor, "{size}"]:
        window = size // SPLITS
        band = torch.zeros(size, device=device)
        band[-window:] = 1
        band[-(window // 2) :] = 2
        return band

    regions = 3 * number_bands(height)[:, None] + number_bands(width)
    numbers = split_windows(regions[None, None, :, :, None])[0, ..., 0]
    return (numbers[:, None, :] != numbers[:, :, None]).float() * MASKED


def encode_window_positions(features: Float[Tensor, "n c h w"]) -> Float[Tensor, "c h w"]:
    """Encode row and column within each window by sines and cosines, as DETR does in an image.

    Half of the channels are of the row, and the others of the column.
    """
    _, channels, height, width = features.shape
    order = torch.arange(channels // 2, device=features.device)
    period = 10000 ** (2 * (order // 2) / len(order))

    def encode_line(size: int) -> Float[Tensor, "{size} half"]:
        number = torch.arange(1, size + 1, device=features.device, dtype=torch.float32)
        angle = (number / (size + 1e-6) * 2 * pi)[:, None] / period
        # Sines and cosines alternate; two channels share a period.
        return torch.stack([angle[:, 0::2].sin(), angle[:, 1::2].cos()], -1).flatten(1)

    rows = encode_line(height // SPLITS).T
    columns = encode_line(width // SPLITS).T
    shape = (-1, rows.shape[1], columns.shape[1])
    window = torch.cat([rows[:, :, None].expand(shape), columns[:, None].expand(shape)])
    # All windows have the same encoding.
    return window.repeat(1, SPLITS, SPLITS)
