"""Rotary embeddings per attention head, which PE-Field adds to diffusers' FLUX transformer.

The heads form four groups, one per quarter of a token. Of six heads in a group, the first uses
the position of the token, the second that of the quarter, the others those of its own quarters.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.diffusion.position_ids import IDS

THETA = 10_000.0
"""Base of the frequencies, as in FLUX."""
HEADS = 24
"""Required number of heads: six per group, on levels 0, 1, 2, 2, 2 and 2."""
POSITION_OF_HEAD = tuple(
    triple
    for quarter in range(4)
    for triple in (0, 1 + quarter, *(5 + 4 * quarter + inner for inner in range(4)))
)
"""Index of each head's position among the 21 of a token."""


class PerHeadRotary(nn.Module):
    """Conversion of position ids to cosines and sines per head."""

    def __init__(self, axes: tuple[int, int, int]) -> None:
        super().__init__()
        self.axes = axes

    def forward(
        self, ids: Float[Tensor, "tokens numbers"]
    ) -> tuple[Float[Tensor, "b tokens 24 d"], Float[Tensor, "b tokens 24 d"]]:
        """Compute cosines and sines from the 63 `ids` of each token, image by image."""
        triples = ids.unflatten(-1, (-1, IDS // 3, 3)).transpose(0, 1)
        triples = triples.to(choose_angle_dtype(ids.device))
        # Of the channels of a head, a part turns with z, one with the row, one with the column.
        angles = torch.cat(
            [triples[..., axis, None] * self.compute_frequencies(axis, ids) for axis in range(3)],
            dim=-1,
        )
        # Both channels of a pair turn by the same angle.
        angles = angles.repeat_interleave(2, dim=-1)
        cosines = angles.cos().float()
        sines = angles.sin().float()
        heads = torch.tensor(POSITION_OF_HEAD, device=ids.device)
        return cosines[:, :, heads], sines[:, :, heads]

    def compute_frequencies(self, axis: int, ids: Tensor) -> Float[Tensor, "pairs"]:
        """Compute the radians per token for each channel pair of an axis."""
        dtype = choose_angle_dtype(ids.device)
        channels = torch.arange(0, self.axes[axis], 2, dtype=dtype, device=ids.device)
        return 1.0 / THETA ** (channels / self.axes[axis])


def choose_angle_dtype(device: torch.device) -> torch.dtype:
    """Return the precision of angles, as in diffusers; the GPU of a Mac has no float64."""
    return torch.float32 if device.type == "mps" else torch.float64


class PerHeadAttention:
    """Attention processor for FLUX blocks with a rotary table per head."""

    # The parameter names are those of diffusers; which it passes depends on its version.
    def __call__(
        self,
        attn: Any,
        hidden_states: Float[Tensor, "b tokens c"],
        encoder_hidden_states: Float[Tensor, "b text c"] | None = None,
        attention_mask: Tensor | None = None,
        image_rotary_emb: tuple[Tensor, Tensor] | None = None,
    ) -> Float[Tensor, "b tokens c"] | tuple[Tensor, Tensor]:
        """Attend among text and image tokens; single blocks pass both as one sequence."""
        layers = (attn.to_q, attn.to_k, attn.to_v)
        query, key, value = project_qkv(hidden_states, layers, (attn.norm_q, attn.norm_k))
        if encoder_hidden_states is not None:
            layers = (attn.add_q_proj, attn.add_k_proj, attn.add_v_proj)
            norms = (attn.norm_added_q, attn.norm_added_k)
            text_query, text_key, text_value = project_qkv(encoder_hidden_states, layers, norms)
            query = torch.cat([text_query, query], dim=1)
            key = torch.cat([text_key, key], dim=1)
            value = torch.cat([text_value, value], dim=1)

        if image_rotary_emb is not None:
            query = rotate_channel_pairs(query, *image_rotary_emb)
            key = rotate_channel_pairs(key, *image_rotary_emb)
        # torch wants the heads before the tokens.
        mixed = nn.functional.scaled_dot_product_attention(
            query.transpose(1, 2), key.transpose(1, 2), value.transpose(1, 2), attention_mask
        )

        joined = mixed.transpose(1, 2).flatten(2).to(query.dtype)
        if encoder_hidden_states is None:
            return joined
        text, image = joined.split([encoder_hidden_states.shape[1], hidden_states.shape[1]], dim=1)
        image = attn.to_out[1](attn.to_out[0](image))
        return image, attn.to_add_out(text)


def project_qkv(
    tokens: Float[Tensor, "b n c"], layers: tuple[nn.Module, ...], norms: tuple[nn.Module, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute query, key and value [b, n, heads, d]; query and key are normalised."""
    to_query, to_key, to_value = layers
    query_norm, key_norm = norms
    query = to_query(tokens).unflatten(-1, (HEADS, -1))
    key = to_key(tokens).unflatten(-1, (HEADS, -1))
    value = to_value(tokens).unflatten(-1, (HEADS, -1))
    return query_norm(query), key_norm(key), value


def rotate_channel_pairs(
    states: Float[Tensor, "b n heads d"],
    cosines: Float[Tensor, "b n heads d"],
    sines: Float[Tensor, "b n heads d"],
) -> Float[Tensor, "b n heads d"]:
    """Rotate each pair of channels, in float32."""
    real, imaginary = states.unflatten(-1, (-1, 2)).unbind(-1)
    # Multiplication by i turns (real, imaginary) by a quarter; with cosines and sines by any angle.
    quarter_rotated = torch.stack([-imaginary, real], dim=-1).flatten(-2)
    return (states.float() * cosines + quarter_rotated.float() * sines).to(states.dtype)


def enable_per_head_positions(transformer: Any) -> Any:
    """Make a FluxTransformer2DModel of 24 heads accept ids [tokens, b * 63]."""
    heads = transformer.config.num_attention_heads
    if heads != HEADS:
        raise ValueError(f"PE-Field needs a transformer of {HEADS} heads, got {heads}")
    transformer.pos_embed = PerHeadRotary(tuple(transformer.config.axes_dims_rope))
    transformer.set_attn_processor(PerHeadAttention())
    return transformer
