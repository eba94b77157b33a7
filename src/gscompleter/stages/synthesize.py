"""Stage 2: synthesize the image at a target camera (paper, Eq. 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gscompleter.config import SynthesisConfig
from gscompleter.generators import (
    Generator,
    GeneratorOutput,
    GeneratorRequest,
    ImageFunction,
    as_generator,
)
from gscompleter.numerics.value_checks import check_colors, check_notes
from gscompleter.stages.select_anchor import find_nearest_view
from gscompleter.stages.target_view import TargetView
from gscompleter.system.errors import InputError
from gscompleter.system.tensor_checks import describe, iterate_tensors
from gscompleter.types import Camera, GeneratorInput, PaddedCamera, Render, View


@dataclass(frozen=True, repr=False)
class GeneratedView(View):
    """The image synthesized at the target, with the notes of its generator."""

    notes: tuple[str, ...] = ()
    """One sentence each, for the results."""
    is_inconsistent: bool = False
    """True if the image is photometrically inconsistent with the photographs."""
    is_photograph: bool = False
    """True if it is a true photograph, which may recolour all that it shows."""
    painter: str = ""
    """Who painted it elsewhere; empty for Φ itself."""

    def crop(self, camera: PaddedCamera) -> View:
        """Cut the padding off the image."""
        return View(camera.crop(self.image), camera.target)


def make_generator_input(view: TargetView) -> GeneratorInput:
    """Collect the input of Φ, whose holes are those of a target."""
    config = view.state.config.holes
    opened = view.masks.edits.opened
    forced = view.masks.edits.forced
    render = view.render
    alpha = view.alpha
    # Φ takes as holes all pixels with too little alpha. Around an object, and away from what was
    # removed, there are such pixels that are no holes: they get full alpha.
    if config.kind == "enclosed" or opened is not None:
        alpha = alpha.where(view.holes, 1.0)
    # What stands in a forced hole is wrong, so that Φ must not see it.
    if forced is not None:
        alpha = alpha.where(~forced, 0.0)
        render = Render(
            render.image * ~forced[..., None], render.depth * ~forced, render.alpha * ~forced
        )
    return GeneratorInput(view.state.views, view.view_renders, render, config.max_alpha, alpha)


def synthesize(
    generator: Generator | ImageFunction,
    inputs: Sequence[tuple[Camera, GeneratorInput]],
    synthesis: SynthesisConfig = SynthesisConfig(),
) -> list[GeneratedView]:
    """Synthesize `Ĩ_t = Φ(I_n, P_t)` for targets in one call of Φ (paper, Eq. 6).

    `inputs` are the targets, padded or not, each with its input of Φ; the views are in their order.
    InputError is raised if Φ returns anything else than it has to, or writes into its input.
    """
    if not inputs:
        return []
    requests = []
    for target, context in inputs:
        nearest = context.views[find_nearest_view(target, context.views)]
        requests.append(GeneratorRequest(nearest, target, context, synthesis))
    # Φ is code of others that gets the scene itself, without a copy of it.
    states = [fingerprint(request) for request in requests]
    outputs = as_generator(generator).synthesize(requests)
    if not isinstance(outputs, (list, tuple)) or len(outputs) != len(requests):
        answer = f"{len(outputs)}" if isinstance(outputs, (list, tuple)) else describe(outputs)
        raise InputError(
            f"The generator got {len(requests)} requests and has to return a list of as many "
            f"outputs, and returned {answer}."
        )
    if [fingerprint(request) for request in requests] != states:
        raise InputError(
            "The generator changed its input, which is the scene itself; let it work on copies "
            "(.clone())."
        )
    return [
        convert_output(output, request.target)
        for output, request in zip(outputs, requests, strict=True)
    ]


def fingerprint(request: GeneratorRequest) -> tuple[object, ...]:
    """Summarize the input of Φ, which must not write into it.

    PyTorch counts what is written in place. NumPy, which shares the memory, does not: the sums
    notice it in the images that a Φ most often paints on.
    """
    # Tensors that were made in inference mode have no version.
    tensors = [tensor for _, tensor in iterate_tensors(request, "") if not tensor.is_inference()]
    versions = [tensor._version for tensor in tensors]
    # Bits are summed as integers: a sum of floats may round a small change away.
    sums = [
        int(image.contiguous().view(torch.int32).sum(dtype=torch.int64))
        for image in (request.nearest.image, request.context.target_render.image)
    ]
    return (*versions, *sums)


def convert_output(output: object, target: Camera) -> GeneratedView:
    """Convert the output of a generator to a view; InputError if it is not what it has to be."""
    if not isinstance(output, GeneratorOutput):
        raise InputError(
            f"The generator has to return a GeneratorOutput per request, and returned "
            f"{describe(output)}."
        )
    image = output.image
    shape = (target.height, target.width, 3)
    is_image = isinstance(image, Tensor) and image.layout is torch.strided
    if not is_image or image.dtype is not torch.float32 or tuple(image.shape) != shape:
        raise InputError(
            f"The generator has to return a finite image of shape {shape} as a float32 tensor, and "
            f"returned {describe(image)}."
        )
    if image.device != target.K.device:
        raise InputError(
            f"The generator returned an image on {image.device} for a target on "
            f"{target.K.device}; move it."
        )
    check_colors(image, "The image of the generator")
    check_notes(output.notes, "generator")
    for name in ("is_inconsistent", "is_photograph"):
        if not isinstance(getattr(output, name), bool):
            raise InputError(
                f"The {name} of the generator has to be True or False, and is "
                f"{describe(getattr(output, name))}."
            )
    if not isinstance(output.painter, str):
        raise InputError(
            f"The painter of the generator has to be a name, and is {describe(output.painter)}."
        )
    return GeneratedView(
        image.detach(),
        target,
        notes=tuple(output.notes),
        is_inconsistent=output.is_inconsistent,
        is_photograph=output.is_photograph,
        painter=output.painter,
    )
