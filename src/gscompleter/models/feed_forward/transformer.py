"""The multi-view transformer of MVSplat and DepthSplat, with window attention."""

from __future__ import annotations

from math import pi

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from gscompleter.models.feed_forward.cameras import select_sources

SPLITS = 2
"""Number of windows along each side of a feature map."""


class WindowAttention(nn.Module):
    """Attention of each pixel to the same window of the source views, with a single head."""

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
        """Attend from `x` to `sources`; with a `mask`, windows are shifted."""
        # Shifted windows (Swin): the image is rolled by half a window, split, and rolled back.
        _, h, w, _ = x.shape
        shift = (0, 0) if mask is None else (h // SPLITS // 2, w // SPLITS // 2)
        back = (-shift[0], -shift[1])
        query = split_windows(self.q_proj(x[:, None].roll(back, (2, 3))))
        sources = sources.roll(back, (2, 3))
        key = split_windows(self.k_proj(sources))
        value = split_windows(self.v_proj(sources))
        if mask is not None:
            # The keys are ordered pixel by pixel, but the mask is repeated view by view, as in
            # the training of the published models. It matters with two or more source views.
            mask = mask.repeat(1, 1, sources.shape[1])
        attended = F.scaled_dot_product_attention(query, key, value, mask)
        return self.norm1(self.merge(merge_windows(attended, h, w).roll(shift, (1, 2))))


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
        """Apply attention, then the MLP."""
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
        """Apply self-attention, then cross-attention."""
        source_maps = select_sources(x, sources).flatten(0, 1)
        own = x.flatten(0, 1)
        own = own + self.self_attn(own, own[:, None], mask)
        return (own + self.cross_attn_ffn(own, source_maps, mask)).view_as(x)


class MultiViewTransformer(nn.Module):
    """Six layers; every other one has windows shifted by half their size."""

    def __init__(self, channels: int = 128, num_layers: int = 6) -> None:
        super().__init__()
        self.layers = nn.ModuleList(TransformerLayer(channels) for _ in range(num_layers))

    def forward(
        self, features: Float[Tensor, "n c h w"], sources: Int[Tensor, "b v s"]
    ) -> Float[Tensor, "n c h w"]:
        """Enrich the features of n = b v views with those of their `sources`."""
        x = (features + encode_window_positions(features)).unflatten(0, sources.shape[:2])
        x = x.permute(0, 1, 3, 4, 2)
        height, width = x.shape[2:4]
        mask = create_shifted_window_mask(height, width, features.device)
        for i, layer in enumerate(self.layers):
            x = layer(x, sources, mask if i % 2 else None)
        return x.permute(0, 1, 4, 2, 3).flatten(0, 1)


def split_windows(x: Float[Tensor, "n s h w c"]) -> Float[Tensor, "n windows p c"]:
    """Split maps into windows of p pixels of s views; the view index changes fastest."""
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
    """Create the attention bias of shifted windows: -100 between opposite image borders."""

    # Rolling brings opposite borders into one window: three bands a side tell them apart.
    def bands(size: int) -> Tensor:
        window = size // SPLITS
        band = torch.zeros(size, device=device)
        band[-window:] = 1
        band[-(window // 2) :] = 2
        return band

    regions = 3 * bands(height)[:, None] + bands(width)
    ids = split_windows(regions[None, None, :, :, None])[0, ..., 0]
    return (ids[:, None, :] != ids[:, :, None]).float() * -100.0


def encode_window_positions(features: Float[Tensor, "n c h w"]) -> Float[Tensor, "c h w"]:
    """Encode row and column within each window by sines and cosines (as in DETR)."""
    _, channels, height, width = features.shape
    order = torch.arange(channels // 2, device=features.device)
    period = 10000 ** (2 * (order // 2) / len(order))

    def along(size: int) -> Float[Tensor, "size c"]:
        number = torch.arange(1, size + 1, device=features.device, dtype=torch.float32)
        angle = (number / (size + 1e-6) * 2 * pi)[:, None] / period
        # Sines and cosines alternate; two channels share a period.
        return torch.stack([angle[:, 0::2].sin(), angle[:, 1::2].cos()], -1).flatten(1)

    rows = along(height // SPLITS).T
    columns = along(width // SPLITS).T
    shape = (-1, rows.shape[1], columns.shape[1])
    window = torch.cat([rows[:, :, None].expand(shape), columns[:, None].expand(shape)])
    # All windows have the same encoding.
    return window.repeat(1, SPLITS, SPLITS)
