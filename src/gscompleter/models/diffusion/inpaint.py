"""Inpainting and editing pipelines of diffusers, applied to photographs warped to the target."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from gscompleter.generators import GeneratorOutput, GeneratorRequest
from gscompleter.generators.agreement import paint_consistently
from gscompleter.generators.warp import BORDER_WIDTH, complete_warp
from gscompleter.models.diffusion.complete import check_parts, load_language_models
from gscompleter.models.diffusion.kontext import resize_antialiased
from gscompleter.models.diffusion.placing import move_to_device, select_dtype
from gscompleter.models.diffusion.published import (
    Source,
    announce,
    check_packages,
    convert_load_errors,
    parse_source,
)
from gscompleter.models.settings import DiffusersInpaintSettings
from gscompleter.numerics.image_ops import dilate
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import convert_to_pixels

UNET_SIDE = 512
"""Side in pixels of the square training images of a U-Net whose configuration tells none: that of
Stable Diffusion 1. The published ones tell theirs (512 to 1024)."""
TRANSFORMER_SIDE = 1024
"""The same for transformers, of which only the pipelines of Z-Image record none: the default size
of its text-to-image pipeline, which its authors use. For Stable Diffusion 3, Flux, FLUX.2 [klein],
Chroma and Qwen-Image diffusers 0.42 records this size, too."""
Z_IMAGE = ("ZImageInpaintPipeline", "ZImageControlNetInpaintPipeline")
"""Pipelines of Z-Image and of Z-Image-Turbo, which was distilled to few steps without guidance."""
TURBO_SHIFT = 3.0
"""Shift of the noise levels in the published scheduler of Z-Image-Turbo. That of Z-Image is 6, by
which the two are told apart: their pipelines and networks have the same classes."""
NO_NEGATIVE_PROMPT = " "
"""Negative prompt that asks for nothing, as the authors of Qwen-Image write it."""
EDITORS = ("Flux2KleinPipeline",)
"""Pipelines of models that edit images by a prompt and were trained without masks."""
PAINTED_OVER = (0.0, 1.0, 0.0)
"""Colour of the hole for them, which no scene has."""
INSTRUCTION = (
    "Replace the plain green areas of the first image by what stands there, so that it becomes one "
    "photograph of the place that the second image shows. Change nothing else: {prompt}."
)
"""Prompt for them, with the user's own in it."""


@dataclass(frozen=True)
class Painter:
    """A loaded inpainting pipeline, with the rules for the sizes of its images."""

    pipeline: Any
    side: int
    """Side length of the square training images, in pixels."""
    multiple: int
    """Number that divides the side lengths of all images, in pixels."""

    def compute_size(self, height: int, width: int) -> tuple[int, int]:
        """Compute a size (height, width) of about `side`² pixels with the image's aspect ratio.

        It may be larger than the image, which is then enlarged: networks paint best at the number
        of pixels that they were trained with.
        """
        scale = self.side / (height * width) ** 0.5
        rows = max(1, round(scale * height / self.multiple))
        columns = max(1, round(scale * width / self.multiple))
        return rows * self.multiple, columns * self.multiple

    def fill_hole(
        self,
        image: Float[Tensor, "h w 3"],
        hole: Bool[Tensor, "h w"],
        reference: Float[Tensor, "_ _ 3"],
        prompt: str,
        seed: int,
        steps: int | None,
    ) -> Float[Tensor, "h w 3"]:
        """Inpaint the hole of an image in [0, 1]; other pixels may change too.

        Args:
            image: Warped photographs, continued into the hole.
            hole: True where the image is painted.
            reference: The nearest photograph, for pipelines that take a reference image.
            prompt: Text that describes the image.
            seed: Seed of the noise.
            steps: Number of denoising steps, or None for the pipeline's default.
        """
        size = self.compute_size(*hole.shape)
        # A pixel of the other size that covers any part of the hole is painted.
        mask = (resize_antialiased(hole[..., None].float(), size) > 0).float()
        wanted: dict[str, Any] = {
            "prompt": prompt,
            "image": resize_antialiased(image, size).permute(2, 0, 1)[None].cpu(),
            "mask_image": mask.permute(2, 0, 1)[None].cpu(),
            # Of its own size, to which the pipeline fits its tokens.
            "image_reference": reference.permute(2, 0, 1)[None].cpu(),
            "height": size[0],
            "width": size[1],
            "strength": 1.0,  # start from pure noise in the hole
            "generator": torch.Generator().manual_seed(seed),
            "output_type": "pt",
            **choose_denoising(self.pipeline, steps),
        }

        # Pipelines differ in their parameters; each gets those of its own.
        known = inspect.signature(self.pipeline.__call__).parameters
        painted = self.pipeline(**{k: v for k, v in wanted.items() if k in known}).images[0]

        return restore_size(painted, image)


@dataclass(frozen=True)
class Editor(Painter):
    """A loaded pipeline that edits images by a prompt, such as FLUX.2 [klein].

    It takes no mask: the hole is painted over, and the prompt says what to do with it.
    """

    def fill_hole(
        self,
        image: Float[Tensor, "h w 3"],
        hole: Bool[Tensor, "h w"],
        reference: Float[Tensor, "_ _ 3"],
        prompt: str,
        seed: int,
        steps: int | None,
    ) -> Float[Tensor, "h w 3"]:
        """Edit an image whose hole is painted over; arguments and result as those of `Painter`.

        The pipeline sees two images, which the prompt calls the first and the second: this one and
        the nearest photograph.
        """
        size = self.compute_size(*hole.shape)
        color = image.new_tensor(PAINTED_OVER)
        over = resize_antialiased(torch.where(hole[..., None], color, image), size)
        shown = [Image.fromarray(convert_to_pixels(picture)) for picture in (over, reference)]
        edited = self.pipeline(
            image=shown,
            prompt=INSTRUCTION.format(prompt=prompt),
            height=size[0],
            width=size[1],
            generator=torch.Generator().manual_seed(seed),
            output_type="pt",
            **choose_denoising(self.pipeline, steps),
        ).images[0]
        return restore_size(edited, image)


def choose_denoising(pipeline: Any, steps: int | None) -> dict[str, Any]:
    """Choose the arguments of denoising that differ from the defaults of the pipeline.

    Models are guided as their authors do. The defaults of a pipeline are those of one model, and
    others that it runs were distilled to few steps, in which guidance spoils the image.
    """
    chosen: dict[str, Any] = {} if steps is None else {"num_inference_steps": steps}
    # FLUX.2 [klein] warns of a scale above 1. For its base models, which are not distilled, a scale
    # of 1 would turn the guidance off.
    if getattr(pipeline.config, "is_distilled", False):
        chosen["guidance_scale"] = 1.0
    # Z-Image adds to the answer for the prompt its difference from the unguided one, times the
    # scale, so that only a scale of 0 is no guidance.
    if type(pipeline).__name__ in Z_IMAGE and pipeline.scheduler.config.get("shift") == TURBO_SHIFT:
        chosen["guidance_scale"] = 0.0
    # A scale of true guidance has no effect without a negative prompt. By default it is above 1 for
    # Qwen-Image, and 1, which is none, for Flux, whose guidance is an input of its network.
    known = inspect.signature(pipeline.__call__).parameters
    if "true_cfg_scale" in known and known["true_cfg_scale"].default > 1:
        chosen["negative_prompt"] = NO_NEGATIVE_PROMPT
    return chosen


def restore_size(
    painted: Float[Tensor, "3 _ _"], image: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w 3"]:
    """Scale what a pipeline painted to the size of `image`, on its device, in [0, 1]."""
    back = resize_antialiased(painted.float().permute(1, 2, 0), (image.shape[0], image.shape[1]))
    return back.clamp(0, 1).to(image.device)


@dataclass(frozen=True)
class DiffusersInpaint:
    """Generator Φ that inpaints warped photographs; see `load_painter`."""

    painter: Painter
    seed: int = 0
    """Seed of the noise; results are reproducible per device."""
    prompt: str = DiffusersInpaintSettings.prompt
    """Text prompt for all images."""
    steps: int | None = None
    """Number of denoising steps, or None for the pipeline's default."""
    retries: int = 0
    """Number of further seeds to try if the image is inconsistent with the warped photographs."""

    supports_padding: ClassVar[bool] = True
    max_batch_size: ClassVar[int] = 1

    def synthesize(self, requests: Sequence[GeneratorRequest]) -> list[GeneratorOutput]:
        """Synthesize images; pixels outside the holes are warped photographs."""
        return [self.paint_hole(request) for request in requests]

    def paint_hole(self, request: GeneratorRequest) -> GeneratorOutput:
        """Synthesize the image of one target."""
        nearest = request.nearest
        observed = complete_warp(nearest, request.target, request.context)
        if observed.known.all():
            # Nothing is left to paint. A network that repaints the photographs in other colours
            # would have them marked as inconsistent with themselves.
            return GeneratorOutput(observed.image)

        # Depth is unsure at the rim of the hole, so that colours warped there neither lead the
        # network nor take part in the comparison. The image keeps them, as all that is known.
        hole = dilate(~observed.known, BORDER_WIDTH)

        def paint(seed: int) -> Float[Tensor, "h w 3"]:
            return self.painter.fill_hole(
                observed.image, hole, nearest.image, self.prompt, seed, self.steps
            )

        compared = replace(observed, known=~hole)
        correct = request.synthesis.correct_color
        painted = paint_consistently(paint, self.seed, compared, self.retries, correct)
        known = observed.known[..., None]
        return replace(painted, image=torch.where(known, observed.image, painted.image))


def load_diffusers_inpaint(
    seed: int = 0,
    device: str = "cpu",
    settings: DiffusersInpaintSettings = DiffusersInpaintSettings(),
) -> DiffusersInpaint:
    """Create the generator from its settings; raises the errors of `load_painter`."""
    painter = load_painter(settings.weights, device, settings.offload)
    return DiffusersInpaint(painter, seed, settings.prompt, settings.steps, settings.retries)


@lru_cache(maxsize=1)
def load_painter(path: str | None, device: str = "cpu", offload: bool = False) -> Painter:
    """Load an inpainting pipeline; the last one is cached.

    Args:
        path: A folder in the format of diffusers, or USER/NAME or USER/NAME@COMMIT on the hub.
        device: cpu (float32) or cuda (bfloat16).
        offload: Keep only the active part on the GPU; slower, and needs accelerate.

    Raises:
        InputError: Packages, the path, or an inpainting pipeline are missing.
    """
    check_packages("diffusers-inpaint")
    if path is None:
        raise InputError(
            "The generator 'diffusers-inpaint' needs the path of a model; give a folder that "
            "diffusers saved or USER/NAME on the Hugging Face hub.",
            "generator_weights",
        )
    source = parse_source(path)
    announce([source])
    with convert_load_errors(source):
        pipeline = load_inpainting_pipeline(source, select_dtype(device))
    move_to_device(pipeline, device, offload)
    kind = Editor if type(pipeline).__name__ in EDITORS else Painter
    return kind(pipeline, *get_size_rules(pipeline))


def load_inpainting_pipeline(source: Source, dtype: torch.dtype) -> Any:
    """Load the pipeline of a folder or repository as one that inpaints, or that edits."""
    import diffusers

    pipeline = diffusers.DiffusionPipeline.from_pretrained(
        source.location, dtype=dtype, **load_language_models(source, dtype), **source.load_arguments
    )
    check_parts(pipeline)
    if {"image", "mask_image"} <= set(inspect.signature(pipeline.__call__).parameters):
        return pipeline
    if type(pipeline).__name__ in EDITORS:
        return pipeline
    return diffusers.AutoPipelineForInpainting.from_pipe(pipeline)


def get_size_rules(pipeline: Any) -> tuple[int, int]:
    """Return the side length of training images and the divisor of side lengths, in pixels.

    Sizes that pipelines and configurations record are in latent pixels.
    """
    # Pixels of the image along the side of a latent pixel.
    latent = int(getattr(pipeline, "vae_scale_factor", 8))
    unet = getattr(pipeline, "unet", None)
    if unet is None:
        recorded = getattr(pipeline, "default_sample_size", None)
        if recorded is None:
            recorded = pipeline.transformer.config.get("sample_size")
        side = TRANSFORMER_SIDE if recorded is None else int(recorded) * latent
        # A transformer joins 2 × 2 latent pixels to a token.
        return side, 2 * latent
    recorded = unet.config.get("sample_size")
    # One number, or height and width.
    if isinstance(recorded, (list, tuple)):
        recorded = max(recorded)
    side = UNET_SIDE if recorded is None else int(recorded) * latent
    # A U-Net halves the latent image between its blocks.
    return side, latent * 2 ** (len(unet.config.block_out_channels) - 1)
