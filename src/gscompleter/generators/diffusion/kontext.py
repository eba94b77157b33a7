"""FLUX.1 Kontext with any position ids: encode the photograph, denoise, decode.

The parts are those of diffusers, unchanged; the loop is ours, for the pipeline of diffusers
computes positions of its own. With plain positions both give the same image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_LONG = (1568, 1504, 1456, 1392, 1328, 1248, 1184, 1104)
_SHORT = (672, 688, 720, 752, 800, 832, 880, 944)
SIZES = ((1024, 1024), *zip(_LONG, _SHORT, strict=True), *zip(_SHORT, _LONG, strict=True))
"""Heights and widths that the model was trained with: about a million pixels each."""


@dataclass(frozen=True)
class Prompt:
    """The encoded prompt. It is the same for all images."""

    tokens: Float[Tensor, "1 text c"]
    """Of T5."""
    pooled: Float[Tensor, "1 p"]
    """Of CLIP."""


@dataclass(frozen=True)
class Kontext:
    """A FLUX Kontext model, ready to denoise."""

    pipeline: Any
    """FluxKontextPipeline of diffusers, whose text encoders are no longer needed."""
    prompt: Prompt
    device: str
    """Where it computes."""
    dtype: torch.dtype
    """What it computes in."""

    @property
    def token_size(self) -> int:
        """Pixels along a side of a token: 16 for FLUX."""
        return 2 * int(self.pipeline.vae_scale_factor)

    def size_for(self, height: int, width: int) -> tuple[int, int]:
        """Height and width that an image of `height` x `width` pixels is worked on at."""
        h, w = nearest_size(height, width)
        return h // self.token_size * self.token_size, w // self.token_size * self.token_size

    def grid(self, size: tuple[int, int]) -> tuple[int, int]:
        """Height and width in tokens of an image of `size` pixels."""
        return size[0] // self.token_size, size[1] // self.token_size

    @torch.inference_mode()
    def generate(
        self,
        photographs: Float[Tensor, "b h w 3"],
        size: tuple[int, int],
        target_positions: Float[Tensor, "n k"],
        source_positions: Float[Tensor, "b m k"],
        seed: int,
        steps: int,
        guidance: float,
    ) -> Float[Tensor, "b height width 3"]:
        """The images at the targets, in [0, 1].

        Args:
            photographs: What is known for each, in [0, 1], at a size that the tokens divide.
            size: Height and width of the images, likewise.
            target_positions: Ids of the tokens of an image, the same for all.
            source_positions: Ids of the tokens of each photograph.
            seed: Of the noise, drawn on the CPU so that every device starts from the same. All
                images start from the same, too, so that none depends on the others.
            steps: Evaluations of the transformer.
            guidance: Scale of the distilled guidance.
        """
        pipeline = self.pipeline
        count, grid = len(photographs), self.grid(size)
        # one at a time: an image in the VAE needs more memory than all its tokens
        source = torch.stack([self.encoded(photograph) for photograph in photographs])
        channels = pipeline.transformer.config.in_channels // 4
        noise = torch.randn(
            (1, channels, 2 * grid[0], 2 * grid[1]),
            generator=torch.Generator().manual_seed(seed),
            dtype=self.dtype,
        )
        latents = in_tokens(noise.to(self.device)).expand(count, -1, -1)
        of_target = target_positions.expand(count, -1, -1)
        positions = torch.cat([of_target, source_positions], dim=1).to(self.device)
        for time in self.times(steps, len(target_positions)):
            velocity = self.velocity(latents, source, positions, time, guidance)
            latents = pipeline.scheduler.step(velocity, time, latents, return_dict=False)[0]
        images = torch.stack([self.decoded(tokens, grid) for tokens in latents])
        pipeline.maybe_free_model_hooks()
        return images

    def velocity(
        self,
        latents: Float[Tensor, "b n c"],
        source: Float[Tensor, "b m c"],
        positions: Float[Tensor, "b all k"],
        time: Tensor,
        guidance: float,
    ) -> Float[Tensor, "b n c"]:
        """What the transformer says about the latents, having read the photographs too."""
        transformer, count = self.pipeline.transformer, len(latents)
        scale = None
        if transformer.config.guidance_embeds:
            scale = torch.full((count,), guidance, device=self.device, dtype=torch.float32)
        ids = positions.transpose(0, 1).flatten(1)  # one image's beside the other's
        (predicted,) = transformer(
            hidden_states=torch.cat([latents, source], dim=1),
            timestep=time.expand(count).to(self.device, latents.dtype) / 1000,
            guidance=scale,
            pooled_projections=self.prompt.pooled.expand(count, -1),
            encoder_hidden_states=self.prompt.tokens.expand(count, -1, -1),
            txt_ids=ids.new_zeros(self.prompt.tokens.shape[1], ids.shape[1]),
            img_ids=ids,
            return_dict=False,
        )
        return predicted[:, : latents.shape[1]]

    def times(self, steps: int, tokens: int) -> Float[Tensor, "steps"]:
        """The times to denoise at, shifted towards noise the more tokens there are."""
        scheduler = self.pipeline.scheduler
        settings = scheduler.config
        few, many = settings.get("base_image_seq_len", 256), settings.get("max_image_seq_len", 4096)
        low, high = settings.get("base_shift", 0.5), settings.get("max_shift", 1.15)
        shift = tokens * (high - low) / (many - few) + low - few * (high - low) / (many - few)
        sigmas = np.linspace(1.0, 1 / steps, steps)
        scheduler.set_timesteps(sigmas=sigmas, mu=shift, device=self.device)
        scheduler.set_begin_index(0)
        return scheduler.timesteps

    def encoded(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "m c"]:
        """The latent tokens of an image in [0, 1]."""
        vae = self.pipeline.vae
        pixels = (2 * image.permute(2, 0, 1)[None] - 1).to(self.device, self.dtype)
        latents = vae.encode(pixels).latent_dist.mode()
        return in_tokens((latents - vae.config.shift_factor) * vae.config.scaling_factor)[0]

    def decoded(
        self, tokens: Float[Tensor, "n c"], grid: tuple[int, int]
    ) -> Float[Tensor, "h w 3"]:
        """The image in [0, 1] that latent tokens stand for."""
        vae = self.pipeline.vae
        latents = tokens[None].unflatten(-1, (-1, 2, 2)).unflatten(1, grid)
        latents = latents.permute(0, 3, 1, 4, 2, 5).flatten(4).flatten(2, 3)
        latents = latents / vae.config.scaling_factor + vae.config.shift_factor
        image = vae.decode(latents, return_dict=False)[0]
        return (image[0].permute(1, 2, 0).float() / 2 + 0.5).clamp(0, 1)


def in_tokens(latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b tokens channels"]:
    """Two by two latent pixels side by side in a token, row after row."""
    blocks = latents.unflatten(3, (-1, 2)).unflatten(2, (-1, 2))  # b c h/2 2 w/2 2
    return blocks.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2)


def nearest_size(height: int, width: int) -> tuple[int, int]:
    """The one of `SIZES` whose aspect is nearest to that of `height` x `width`."""
    aspect = width / height
    return min(SIZES, key=lambda size: (abs(aspect - size[1] / size[0]), size[1]))


def resized(
    image: Float[Tensor, "h w c"], size: tuple[int, int]
) -> Float[Tensor, "height width c"]:
    """`image` at `size`: linear where it grows, averaged over areas where it shrinks."""
    if tuple(image.shape[:2]) == size:
        return image
    channels = image.permute(2, 0, 1)[None]
    shrinks = size[0] < image.shape[0] or size[1] < image.shape[1]
    grown = torch.nn.functional.interpolate(
        channels, size, mode="bilinear", align_corners=False, antialias=shrinks
    )
    return grown[0].permute(1, 2, 0)
