"""PE-Field: a diffusion transformer that reads the photograph at its target positions.

The camera motion enters only by positions: each token of the photograph is placed where the
target camera sees its content (`position_ids`). Attention fills the holes. Of the photographs, only
the one nearest to the target is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.generators import GeneratorOutput, GeneratorRequest
from gscompleter.generators.agreement import paint_consistently
from gscompleter.generators.warp import warp_photographs
from gscompleter.models.diffusion.kontext import Kontext, resize_antialiased
from gscompleter.models.diffusion.loading import load_kontext
from gscompleter.models.diffusion.position_ids import (
    compute_source_ids,
    compute_target_ids,
)
from gscompleter.models.diffusion.source_depth import (
    SourceDepth,
    load_source_depth,
)
from gscompleter.models.settings import PEFieldSettings
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.system.errors import InputError
from gscompleter.types import GeneratorInput, Render, View

GUIDANCE = 3.5
"""Scale of the distilled guidance."""


@dataclass(frozen=True)
class Condition:
    """Input of the model for one target."""

    photograph: Float[Tensor, "h w 3"]
    """The nearest photograph in a size of the training, with colours in [0, 1]."""
    size: tuple[int, int]
    """Height and width in pixels of the image to generate, also of the training."""
    source_positions: Float[Tensor, "m 63"]
    """Positions of the photograph's m tokens in the target camera, 21 of 3 numbers each."""


@dataclass(frozen=True)
class PEField:
    """The paper's generator Φ; see `load_kontext` for the model."""

    model: Kontext
    seed: int = 0
    """Seed of the noise; results are reproducible per device."""
    steps: int = PEFieldSettings.steps
    """Number of denoising steps."""
    depth: SourceDepth | None = None
    """Source of the photograph's depth, or None to use the setting of the completer."""
    device: str = "cpu"
    ids_dtype: torch.dtype = torch.bfloat16
    """Rounding of target positions; bfloat16 as in the authors' code."""
    retries: int = 0
    """Number of further seeds to try if an image is inconsistent with the photographs."""
    max_batch_size: int = PEFieldSettings.batch_size
    """Largest number of images denoised together."""

    supports_padding: bool = True

    def synthesize(self, requests: Sequence[GeneratorRequest]) -> list[GeneratorOutput]:
        """Synthesize the images of `requests`, with colours adjusted to the photographs.

        Raises:
            InputError: The scene has no depth at the nearest photograph.
        """
        conditions = [self.create_condition(request) for request in requests]
        # The first seed for all targets, in batches; further seeds are needed by few of them.
        first: dict[int, Tensor] = {}
        for group in group_by_size(conditions, self.max_batch_size):
            images = self.generate_images([conditions[i] for i in group], self.seed)
            first.update(zip(group, images, strict=True))

        def complete(i: int) -> GeneratorOutput:
            nearest = requests[i].nearest
            target = requests[i].target

            def paint(seed: int) -> Float[Tensor, "h w 3"]:
                if seed == self.seed:
                    image = first[i]
                else:
                    image = self.generate_images([conditions[i]], seed)[0]
                # From the size of the model to that of the target.
                resized = resize_antialiased(image, (target.height, target.width)).clamp(0, 1)
                return resized.to(nearest.image.device)

            # Photographs, warped to the target, judge the image and correct its colours.
            observed = warp_photographs(nearest, target, requests[i].context)
            correct = requests[i].synthesis.correct_color
            return paint_consistently(paint, self.seed, observed, self.retries, correct)

        return [complete(i) for i in range(len(requests))]

    def create_condition(self, request: GeneratorRequest) -> Condition:
        """Create the model input for a target; raises the errors of `synthesize`."""
        nearest = request.nearest
        target = request.target
        size = self.model.compute_size(target.height, target.width)
        source_size = self.model.compute_size(nearest.camera.height, nearest.camera.width)
        source_grid = self.model.compute_grid(source_size)
        target_grid = self.model.compute_grid(size)
        estimate = self.depth or load_source_depth(request.synthesis.source_depth, self.device)
        depth = estimate(nearest, find_render(nearest, request.context))
        # Where the target sees what the photograph shows; the network draws it there.
        positions = compute_source_ids(depth, nearest.camera, target, source_grid, target_grid)
        photograph = resize_antialiased(nearest.image, source_size)
        return Condition(photograph, size, positions.cpu())

    def generate_images(
        self, conditions: Sequence[Condition], seed: int
    ) -> Float[Tensor, "b h w 3"]:
        """Generate an image for each condition, in the size of the model.

        All of them must have equal sizes, as in a group of `group_by_size`.
        """
        size = conditions[0].size
        return self.model.generate(
            torch.stack([one.photograph for one in conditions]),
            size,
            compute_target_ids(size, self.model.compute_grid(size), self.ids_dtype),
            torch.stack([one.source_positions for one in conditions]),
            seed,
            self.steps,
            GUIDANCE,
        )


def group_by_size(conditions: Sequence[Condition], max_size: int) -> list[list[int]]:
    """Group the indices of conditions of equal sizes into batches of at most `max_size`."""
    alike: dict[tuple[tuple[int, int], torch.Size], list[int]] = {}
    for i, one in enumerate(conditions):
        alike.setdefault((one.size, one.photograph.shape), []).append(i)
    return [
        indices[start : start + max_size]
        for indices in alike.values()
        for start in range(0, len(indices), max_size)
    ]


def find_render(view: View, context: GeneratorInput) -> Render:
    """Find the render of the scene at `view`, one of the context views."""
    for known, render in zip(context.views, context.view_renders, strict=True):
        if known is view or is_same_camera(known.camera, view.camera):
            return render
    raise InputError("The nearest view is not a view of the scene; give one of its views.")


def load_pe_field(
    seed: int = 0, device: str = "cpu", settings: PEFieldSettings = PEFieldSettings()
) -> PEField:
    """Create PE-Field from its settings; raises InputError if packages or weights are missing."""
    return PEField(
        load_kontext(settings.weights, device, settings.offload),
        seed,
        settings.steps,
        None if settings.depth is None else load_source_depth(settings.depth, device),
        device,
        retries=settings.retries,
        max_batch_size=settings.batch_size,
    )
