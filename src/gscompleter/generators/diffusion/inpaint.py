"""Any inpainting pipeline of diffusers, given the photographs warped into the target.

The pipeline paints the hole; what the photographs show stays as it was warped. Sizes and the
arguments of a pipeline are read from its configuration and its signature.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config.generators import DiffusersInpaintSettings
from gscompleter.errors import InputError
from gscompleter.generators import Synthesis
from gscompleter.generators.agreement import checked
from gscompleter.generators.diffusion.complete import check_parts, language_models
from gscompleter.generators.diffusion.kontext import resized
from gscompleter.generators.diffusion.placing import place, precision_on
from gscompleter.generators.diffusion.published import (
    Source,
    announce,
    needs_diffusers,
    reading,
    source_of,
)
from gscompleter.generators.warp import (
    Warped,
    background_first,
    warp_photographs,
    with_unexplained,
)
from gscompleter.masks import dilate
from gscompleter.types import Camera, SceneContext, View

SIDE = 512
"""Side of the square whose area is painted where a pipeline's configuration names none."""
MARGIN = 4
"""Pixels around a hole that the pipeline may paint anew, so that it meets no hard border. In the
image that is returned they are as they were warped."""


@dataclass(frozen=True)
class Painter:
    """A loaded inpainting pipeline, and how its images must be sized."""

    pipeline: Any
    """A pipeline of diffusers that takes `image` and `mask_image`."""
    side: int
    """Side of the square image that it was trained on, in pixels."""
    multiple: int
    """Both sides of an image must be multiples of this."""

    def size_for(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of about `side`² pixels, in the proportions of the image."""
        scale = self.side / (height * width) ** 0.5
        h, w = (max(1, round(scale * n / self.multiple)) for n in (height, width))
        return h * self.multiple, w * self.multiple

    def paint(
        self,
        image: Float[Tensor, "h w 3"],
        hole: Bool[Tensor, "h w"],
        prompt: str,
        seed: int,
        steps: int | None,
    ) -> Float[Tensor, "h w 3"]:
        """`image` with the hole painted, as the pipeline returns all of it."""
        size = self.size_for(*hole.shape)
        mask = (resized(hole[..., None].float(), size) > 0).float()
        wanted: dict[str, Any] = {
            "prompt": prompt,
            "image": resized(image, size).permute(2, 0, 1)[None].cpu(),
            "mask_image": mask.permute(2, 0, 1)[None].cpu(),
            "height": size[0],
            "width": size[1],
            "strength": 1.0,  # the hole starts from noise alone
            "generator": torch.Generator().manual_seed(seed),
            "output_type": "pt",
        }
        if steps is not None:
            wanted["num_inference_steps"] = steps
        known = inspect.signature(self.pipeline.__call__).parameters
        painted = self.pipeline(**{k: v for k, v in wanted.items() if k in known}).images[0]
        back = resized(painted.float().permute(1, 2, 0), (hole.shape[0], hole.shape[1]))
        return back.clamp(0, 1).to(image.device)


@dataclass(frozen=True)
class DiffusersInpaint:
    """Φ by any inpainting pipeline. `load_painter` gives it."""

    painter: Painter
    """What paints."""
    seed: int = 0
    """Of its noise; the same seed gives the same image on the same device."""
    prompt: str = DiffusersInpaintSettings.prompt
    """What it is told, whatever the image."""
    steps: int | None = None
    """Denoising steps; the pipeline's own number if None."""
    retries: int = 0
    """How many further seeds are tried where the painting disagrees with what was warped."""

    def __call__(self, nearest: View, target: Camera, context: SceneContext) -> Synthesis:
        """The image `target` would take; outside of the hole it is the warped one."""
        observed = completed_warp(nearest, target, context)
        hole = dilate(~observed.known, MARGIN)

        def paint(seed: int) -> Float[Tensor, "h w 3"]:
            return self.painter.paint(observed.image, hole, self.prompt, seed, self.steps)

        compared = replace(observed, known=~hole)
        correct = context.correct_color
        painted = checked(paint, self.seed, compared, self.retries, correct)
        known = observed.known[..., None]
        return replace(painted, image=torch.where(known, observed.image, painted.image))


def completed_warp(nearest: View, target: Camera, context: SceneContext) -> Warped:
    """What the photographs show of the target, over a smooth continuation of its colours."""
    warped = warp_photographs(nearest, target, context)
    if not warped.known.any():
        return replace(warped, image=nearest.image.mean(dim=(0, 1)).expand_as(warped.image))
    warped = with_unexplained(warped, target, context)
    tone, _ = background_first(warped)
    return replace(warped, image=tone.clamp(0, 1).to(warped.image.device))


def load_diffusers_inpaint(
    seed: int = 0,
    device: str = "cpu",
    settings: DiffusersInpaintSettings = DiffusersInpaintSettings(),
) -> DiffusersInpaint:
    """Φ as the settings want it; errors as those of `load_painter`."""
    painter = load_painter(settings.weights, device, settings.offload)
    return DiffusersInpaint(painter, seed, settings.prompt, settings.steps, settings.retries)


@lru_cache(maxsize=1)
def load_painter(path: str | None, device: str = "cpu", offload: bool = False) -> Painter:
    """An inpainting pipeline, loaded once in a process.

    Args:
        path: A folder that diffusers saved, or USER/NAME or USER/NAME@COMMIT on the hub.
        device: cpu or cuda. On a GPU all is bfloat16, on a CPU float32.
        offload: Keep on the GPU only the part that is at work. Slower, and needs accelerate.

    Raises:
        InputError: packages are missing, no path was given, or there is no inpainting pipeline.
    """
    needs_diffusers("diffusers-inpaint")
    if path is None:
        raise InputError(
            "The generator 'diffusers-inpaint' needs the path of a model; give a folder that "
            "diffusers saved or USER/NAME on the Hugging Face hub.",
            "generator_weights",
        )
    source = source_of(path)
    announce([source])
    with reading(source):
        pipeline = inpainting(source, precision_on(device))
    place(pipeline, device, offload)
    return Painter(pipeline, *size_rules(pipeline))


def inpainting(source: Source, dtype: torch.dtype) -> Any:
    """The pipeline that a folder or repository names, as an inpainting one."""
    from diffusers import AutoPipelineForInpainting, DiffusionPipeline

    pipeline = DiffusionPipeline.from_pretrained(
        source.place, dtype=dtype, **language_models(source, dtype), **source.arguments
    )
    check_parts(pipeline)
    if {"image", "mask_image"} <= set(inspect.signature(pipeline.__call__).parameters):
        return pipeline
    return AutoPipelineForInpainting.from_pipe(pipeline)


def size_rules(pipeline: Any) -> tuple[int, int]:
    """Side of the trained square in pixels, and what an image's sides must be multiples of.

    A UNet halves its latents on every level but the first; a transformer pairs them up.
    """
    latent = int(getattr(pipeline, "vae_scale_factor", 8))
    unet = getattr(pipeline, "unet", None)
    if unet is None:
        return int(getattr(pipeline, "default_sample_size", SIDE // latent)) * latent, 2 * latent
    side = unet.config.get("sample_size") or SIDE // latent
    side = max(side) if isinstance(side, (list, tuple)) else int(side)
    return side * latent, latent * 2 ** (len(unet.config.block_out_channels) - 1)
