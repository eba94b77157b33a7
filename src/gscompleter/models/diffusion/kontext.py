"""FLUX.1 Kontext with arbitrary position ids: encode the photograph, denoise, decode.

The parts are those of diffusers; the loop is ours, because its pipeline fixes the positions.
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
"""Heights and widths of the training images: about a million pixels each."""


@dataclass(frozen=True)
class Prompt:
    """The encoded prompt: token embeddings of T5 and the pooled embedding of CLIP."""

    tokens: Float[Tensor, "1 text c"]
    pooled: Float[Tensor, "1 p"]


@dataclass(frozen=True)
class Kontext:
    """A FLUX Kontext model (FluxKontextPipeline of diffusers) with an encoded prompt."""

    pipeline: Any
    prompt: Prompt
    device: str
    dtype: torch.dtype

    @property
    def token_size(self) -> int:
        """Side length of a token in pixels: 16 for FLUX."""
        return 2 * int(self.pipeline.vae_scale_factor)

    def compute_size(self, height: int, width: int) -> tuple[int, int]:
        """Compute the processing size of an image of `height` x `width` pixels."""
        h, w = find_nearest_size(height, width)
        return h // self.token_size * self.token_size, w // self.token_size * self.token_size

    def compute_grid(self, size: tuple[int, int]) -> tuple[int, int]:
        """Compute height and width in tokens of an image of `size` pixels."""
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
        """Generate the images at the targets, in [0, 1].

        Args:
            photographs: One source image per target in [0, 1], with sides divisible by the tokens.
            size: Height and width of the generated images, likewise divisible.
            target_positions: Position ids of the generated tokens, the same for all.
            source_positions: Position ids of the photographs' tokens.
            seed: Seed of the noise, which is the same for all images and devices.
            steps: Number of denoising steps.
            guidance: Scale of the distilled guidance.
        """
        pipeline = self.pipeline
        count = len(photographs)
        grid = self.compute_grid(size)
        # One at a time: the VAE needs much more memory than the tokens.
        source = torch.stack([self.encode_image(photograph) for photograph in photographs])
        # The transformer takes 2 × 2 latent pixels as a token of four times the channels.
        channels = pipeline.transformer.config.in_channels // 4

        # On the CPU, whose generator gives the same noise for every device.
        noise = torch.randn(
            (1, channels, 2 * grid[0], 2 * grid[1]),
            generator=torch.Generator().manual_seed(seed),
            dtype=self.dtype,
        )
        latents = pack_tokens(noise.to(self.device)).expand(count, -1, -1)
        # One sequence: the tokens of the image to generate, then those of the photograph.
        repeated_target = target_positions.expand(count, -1, -1)
        positions = torch.cat([repeated_target, source_positions], dim=1).to(self.device)

        for time in self.compute_timesteps(steps, len(target_positions)):
            velocity = self.predict_velocity(latents, source, positions, time, guidance)
            latents = pipeline.scheduler.step(velocity, time, latents, return_dict=False)[0]
        images = torch.stack([self.decode_tokens(tokens, grid) for tokens in latents])
        pipeline.maybe_free_model_hooks()
        return images

    def predict_velocity(
        self,
        latents: Float[Tensor, "b n c"],
        source: Float[Tensor, "b m c"],
        positions: Float[Tensor, "b all k"],
        time: Tensor,
        guidance: float,
    ) -> Float[Tensor, "b n c"]:
        """Predict the velocity of the latents, given the photographs' tokens."""
        transformer = self.pipeline.transformer
        count = len(latents)
        scale = None
        if transformer.config.guidance_embeds:
            scale = torch.full((count,), guidance, device=self.device, dtype=torch.float32)
        ids = positions.transpose(0, 1).flatten(1)  # the images side by side
        (predicted,) = transformer(
            hidden_states=torch.cat([latents, source], dim=1),
            # diffusers gives timesteps from 0 to 1000, the network takes 0 to 1.
            timestep=time.expand(count).to(self.device, latents.dtype) / 1000,
            guidance=scale,
            pooled_projections=self.prompt.pooled.expand(count, -1),
            encoder_hidden_states=self.prompt.tokens.expand(count, -1, -1),
            txt_ids=ids.new_zeros(self.prompt.tokens.shape[1], ids.shape[1]),
            img_ids=ids,
            return_dict=False,
        )
        # Of the answer only the part of the generated image; the photograph stays as it is.
        return predicted[:, : latents.shape[1]]

    def compute_timesteps(self, steps: int, tokens: int) -> Float[Tensor, "steps"]:
        """Compute the denoising timesteps; more tokens shift them towards noise."""
        scheduler = self.pipeline.scheduler
        settings = scheduler.config
        few = settings.get("base_image_seq_len", 256)
        many = settings.get("max_image_seq_len", 4096)
        low = settings.get("base_shift", 0.5)
        high = settings.get("max_shift", 1.15)
        # A line through the shifts that FLUX names for few and for many tokens, as diffusers draws
        # it.
        shift = tokens * (high - low) / (many - few) + low - few * (high - low) / (many - few)
        sigmas = np.linspace(1.0, 1 / steps, steps)
        scheduler.set_timesteps(sigmas=sigmas, mu=shift, device=self.device)
        scheduler.set_begin_index(0)
        return scheduler.timesteps

    def encode_image(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "m c"]:
        """Encode an image in [0, 1] into latent tokens."""
        vae = self.pipeline.vae
        pixels = (2 * image.permute(2, 0, 1)[None] - 1).to(self.device, self.dtype)
        # The mode instead of a sample, so that the same photograph gives the same tokens.
        latents = vae.encode(pixels).latent_dist.mode()
        return pack_tokens((latents - vae.config.shift_factor) * vae.config.scaling_factor)[0]

    def decode_tokens(
        self, tokens: Float[Tensor, "n c"], grid: tuple[int, int]
    ) -> Float[Tensor, "h w 3"]:
        """Decode latent tokens into an image in [0, 1]."""
        vae = self.pipeline.vae
        # The inverse of `pack_tokens`: b h/2 w/2 c 2 2 to b c h w.
        latents = tokens[None].unflatten(-1, (-1, 2, 2)).unflatten(1, grid)
        latents = latents.permute(0, 3, 1, 4, 2, 5).flatten(4).flatten(2, 3)
        latents = latents / vae.config.scaling_factor + vae.config.shift_factor
        image = vae.decode(latents, return_dict=False)[0]
        return (image[0].permute(1, 2, 0).float() / 2 + 0.5).clamp(0, 1)


def pack_tokens(latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b tokens channels"]:
    """Pack blocks of 2 x 2 latent pixels into tokens, row by row."""
    blocks = latents.unflatten(3, (-1, 2)).unflatten(2, (-1, 2))  # b c h/2 2 w/2 2
    return blocks.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2)


def find_nearest_size(height: int, width: int) -> tuple[int, int]:
    """Select the entry of `SIZES` with the nearest aspect ratio."""
    aspect = width / height
    return min(SIZES, key=lambda size: (abs(aspect - size[1] / size[0]), size[1]))


def resize_antialiased(
    image: Float[Tensor, "h w c"], size: tuple[int, int]
) -> Float[Tensor, "height width c"]:
    """Resize an image bilinearly, with antialiasing if it shrinks."""
    if tuple(image.shape[:2]) == size:
        return image
    channels = image.permute(2, 0, 1)[None]
    shrinks = size[0] < image.shape[0] or size[1] < image.shape[1]
    grown = torch.nn.functional.interpolate(
        channels, size, mode="bilinear", align_corners=False, antialias=shrinks
    )
    return grown[0].permute(1, 2, 0)
