"""A DINOv2 transformer whose later blocks alternate between single views and all views."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from gscompleter.models.depth_anything.config import VitConfig
from gscompleter.models.depth_anything.reference_view import order_views, select_reference_view
from gscompleter.models.depth_anything.rotary import (
    RotaryEmbedding,
    compute_rotary_embedding,
    list_shared_positions,
    list_view_positions,
)
from gscompleter.models.feed_forward import dino
from gscompleter.models.feed_forward.dino import (
    GRID,
    PATCH,
    LayerScale,
    Mlp,
    PatchEmbedding,
    resize_position_embeddings,
)


@dataclass(frozen=True)
class Tokens:
    """Patch tokens (row by row) and camera tokens of a block."""

    patches: Float[Tensor, "b v p c"]
    camera: Float[Tensor, "b v c"]

    def float(self) -> Tokens:
        """Convert to float32, the precision of the heads."""
        return Tokens(self.patches.float(), self.camera.float())


class RotaryAttention(dino.Attention):
    """Self-attention with rotary position embedding."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__(channels, heads)
        self.q_norm = nn.LayerNorm(channels // heads)
        self.k_norm = nn.LayerNorm(channels // heads)

    def forward(  # type: ignore[override]
        self, x: Float[Tensor, "n t c"], turns: RotaryEmbedding
    ) -> Float[Tensor, "n t c"]:
        """Apply self-attention to tokens rotated by `turns`."""
        q, k, v = self.qkv(x).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q = turns(self.q_norm(q))
        k = turns(self.k_norm(k))
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class GatedMlp(nn.Module):
    """MLP with a gated hidden layer (SwiGLU)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        # Two thirds of the usual width, since a gated MLP has three matrices, in multiples of 8.
        hidden = -(-(4 * channels * 2 // 3) // 8) * 8
        self.w12 = nn.Linear(channels, 2 * hidden)
        self.w3 = nn.Linear(hidden, channels)

    def forward(self, x: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        """Apply the MLP."""
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(F.silu(gate) * value)


class Block(nn.Module):
    """A layer of the transformer."""

    def __init__(self, channels: int, attention: nn.Module, mlp: nn.Module, eps: float) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels, eps=eps)
        self.attn = attention
        self.ls1 = LayerScale(channels)
        self.norm2 = nn.LayerNorm(channels, eps=eps)
        self.mlp = mlp
        self.ls2 = LayerScale(channels)

    def forward(self, x: Float[Tensor, "n t c"], *turns: RotaryEmbedding) -> Float[Tensor, "n t c"]:
        """Apply attention, then the MLP."""
        x = x + self.ls1(self.attn(self.norm1(x), *turns))
        return x + self.ls2(self.mlp(self.norm2(x)))


class AnyViewVit(nn.Module):
    """A vision transformer over the views of a scene.

    The first blocks process single views. From `first_multi_view_block` on, a camera token replaces
    the class token, and odd blocks process all views jointly. If that is None (monocular models),
    all blocks process single views. Names of parameters and modules are the keys of the published
    weights, and layers are normalised as there: blocks with another epsilon than the rest.
    """

    def __init__(self, config: VitConfig) -> None:
        super().__init__()
        self.config = config
        channels = config.channels
        start = config.first_multi_view_block
        self.cls_token = nn.Parameter(torch.zeros(1, 1, channels))
        if start is not None:
            self.camera_token = nn.Parameter(torch.zeros(1, 2, channels))
        self.pos_embed = nn.Parameter(torch.zeros(1, GRID**2 + 1, channels))
        self.patch_embed = PatchEmbedding(channels)
        self.blocks = nn.ModuleList(self.create_block(i) for i in range(config.blocks))
        self.norm = nn.LayerNorm(channels)

    def create_block(self, number: int) -> Block:
        """Create a block, with rotary embedding in the multi-view part."""
        c = self.config
        attention = RotaryAttention if self.is_multi_view_block(number) else dino.Attention
        mlp = GatedMlp(c.channels) if c.is_gated else Mlp(c.channels)
        return Block(c.channels, attention(c.channels, c.heads), mlp, eps=1e-6)

    def is_multi_view_block(self, number: int) -> bool:
        """Return True for blocks of the multi-view part."""
        start = self.config.first_multi_view_block
        return start is not None and number >= start

    def forward(
        self, images: Float[Tensor, "b v 3 h w"], cameras: Float[Tensor, "b v c"] | None = None
    ) -> list[Tokens]:
        """Compute the tokens of the output blocks, in the order of the views.

        Images are normalised, with sides in multiples of `PATCH`. `cameras` are tokens of encoded
        poses, None if these are unknown.
        """
        scenes, views = images.shape[:2]
        x = self.embed_views(images)
        size = (images.shape[3] // PATCH, images.shape[4] // PATCH)
        within = compute_rotary_embedding(list_view_positions(*size, images.device))
        among = compute_rotary_embedding(
            list_shared_positions(views, size[0] * size[1], images.device)
        )

        order = torch.arange(views, device=images.device).expand(scenes, -1)
        start = self.config.first_multi_view_block

        outputs = []
        # Tokens after the last block that looked at each view alone; heads get these as well.
        local = x
        for number, block in enumerate(self.blocks):
            # Without poses, the first view is the reference of all; a central one is moved to its
            # place, chosen by the class tokens before the last single-view block.
            if start is not None and number == start - 1 and cameras is None and views > 2:
                order = order_views(select_reference_view(x[:, :, 0].float()), views)
                x = reorder_views(x, order)
                local = reorder_views(local, order)
            if number == start:
                camera_tokens = self.select_camera_tokens(cameras, scenes, views)
                x = torch.cat([camera_tokens, x[:, :, 1:]], dim=2)
            if not self.is_multi_view_block(number):
                x = block(x.flatten(0, 1)).unflatten(0, (scenes, views))
                local = x
            elif number % 2:
                # All tokens of all views in one sequence.
                x = block(x.flatten(1, 2), among).unflatten(1, (views, -1))
            else:
                x = block(x.flatten(0, 1), within).unflatten(0, (scenes, views))
                local = x
            if number in self.config.output_block_ids:
                # In the order of the photographs again.
                back = order.argsort(dim=1)
                outputs.append(self.join_tokens(reorder_views(local, back), reorder_views(x, back)))
        return outputs

    def embed_views(self, images: Float[Tensor, "b v 3 h w"]) -> Float[Tensor, "b v t c"]:
        """Embed class token and patches of each view, with positions."""
        patches = self.patch_embed(images.flatten(0, 1))
        size = (images.shape[3] // PATCH, images.shape[4] // PATCH)
        tokens = torch.cat([self.cls_token.expand(len(patches), -1, -1), patches], 1)
        tokens = tokens + resize_position_embeddings(self.pos_embed, *size)
        return tokens.unflatten(0, images.shape[:2])

    def select_camera_tokens(
        self, cameras: Float[Tensor, "b v c"] | None, scenes: int, views: int
    ) -> Float[Tensor, "b v 1 c"]:
        """Return the given tokens, or learned ones for the first view and for all others."""
        if cameras is not None:
            return cameras[:, :, None]
        first = self.camera_token[:, :1]
        other = self.camera_token[:, 1:].expand(-1, views - 1, -1)
        tokens = torch.cat([first, other], 1)
        return tokens[:, :, None].expand(scenes, -1, -1, -1)

    def join_tokens(self, local: Float[Tensor, "b v t c"], x: Float[Tensor, "b v t c"]) -> Tokens:
        """Join the tokens of a block with `local`, those of the last block on single views.

        Only the patch tokens of the block itself are normalized. Without a multi-view part there is
        nothing to join.
        """
        normed = self.norm(x)
        if self.config.first_multi_view_block is None:
            return Tokens(normed[:, :, 1:], x[:, :, 0])
        patches = torch.cat([local[:, :, 1:], normed[:, :, 1:]], -1)
        return Tokens(patches, torch.cat([local[:, :, 0], x[:, :, 0]], -1))


def reorder_views(
    x: Float[Tensor, "b v t c"], order: Int[Tensor, "b v"]
) -> Float[Tensor, "b v t c"]:
    """Reorder the views of each scene."""
    return x.take_along_dim(order[:, :, None, None], dim=1)
