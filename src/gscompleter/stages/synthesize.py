"""Stage 2: synthesize the image at a target camera (paper, Eq. 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from gscompleter.generators import (
    Generator,
    GeneratorOutput,
    GeneratorRequest,
    ImageFunction,
    as_generator,
)
from gscompleter.stages.select_anchor import find_nearest_view
from gscompleter.types import Camera, GeneratorInput, PaddedCamera, View


@dataclass(frozen=True)
class GeneratedView(View):
    """The image synthesized at the target, with the notes of its generator."""

    notes: tuple[str, ...] = ()
    """One sentence each, for the results."""
    is_inconsistent: bool = False
    """True if the image is photometrically inconsistent with the photographs."""
    is_photograph: bool = False

    def crop(self, camera: PaddedCamera) -> View:
        """Cut the padding off the image."""
        return View(camera.crop(self.image), camera.target)


def synthesize(
    generator: Generator | ImageFunction, inputs: Sequence[tuple[Camera, GeneratorInput]]
) -> list[GeneratedView]:
    """Synthesize `Ĩ_t = Φ(I_n, P_t)` for targets in one call of Φ (paper, Eq. 6)."""
    if not inputs:
        return []
    requests = [
        GeneratorRequest(context.views[find_nearest_view(target, context.views)], target, context)
        for target, context in inputs
    ]
    outputs = as_generator(generator).synthesize(requests)
    return [convert_output(output, r.target) for output, r in zip(outputs, requests, strict=True)]


def convert_output(output: GeneratorOutput, target: Camera) -> GeneratedView:
    """Convert the output of a generator to a view, after checking its size and values."""
    expected = (target.height, target.width, 3)
    if tuple(output.image.shape) != expected or not torch.isfinite(output.image).all():
        shape = tuple(output.image.shape)
        raise ValueError(
            f"the generator must return a finite image of shape {expected}, got {shape}"
        )
    return GeneratedView(
        output.image,
        target,
        notes=output.notes,
        is_inconsistent=output.is_inconsistent,
        is_photograph=output.is_photograph,
    )
