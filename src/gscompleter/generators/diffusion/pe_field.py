"""PE-Field: a diffusion transformer that reads the photograph at the target camera's positions.

The model is told by nothing but positions how the camera moved: every token of the photograph
stands where the target camera sees what it shows. Holes are filled through attention alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.config.generators import PEFieldSettings
from gscompleter.errors import InputError
from gscompleter.generators import Request, Synthesis
from gscompleter.generators.agreement import checked
from gscompleter.generators.diffusion.kontext import Kontext, resized
from gscompleter.generators.diffusion.loading import load_kontext
from gscompleter.generators.diffusion.position_ids import seen_from, source_ids, target_ids
from gscompleter.generators.diffusion.source_depth import (
    SourceDepth,
    context_depth,
    source_depth_named,
)
from gscompleter.generators.diffusion.splat import forward_splat
from gscompleter.generators.warp import warp_photographs
from gscompleter.geometry import same_camera
from gscompleter.types import Camera, Render, SceneContext, View

GUIDANCE = 3.5
"""Scale of the distilled guidance."""


@dataclass(frozen=True)
class Condition:
    """What the model is told of one target."""

    photograph: Float[Tensor, "h w 3"]
    """At the size that it is worked on."""
    size: tuple[int, int]
    """Height and width that the target is painted at."""
    source_positions: Float[Tensor, "m 63"]
    """Where the target camera sees the tokens of the photograph."""


@dataclass(frozen=True)
class PEField:
    """Φ of the paper. `load_kontext` gives the model."""

    model: Kontext
    """FLUX Kontext with per-head positions."""
    seed: int = 0
    """Of the noise; the same seed gives the same image on the same device."""
    steps: int = PEFieldSettings.steps
    """Evaluations of the transformer."""
    depth: SourceDepth | None = None
    """Depth of the photograph: of the scene itself, or `MonocularDepth`; None takes what the
    completer's settings name."""
    device: str = "cpu"
    """Device of a depth network that the completer's settings name."""
    ids_dtype: torch.dtype = torch.bfloat16
    """What positions of the target are rounded to: bfloat16 as in the authors' run."""
    retries: int = 0
    """How many further seeds are tried where an image disagrees with the photographs."""
    at_once: int = PEFieldSettings.batch_size
    """Most images that are denoised together."""

    takes_margin: bool = True

    def synthesize(self, requests: Sequence[Request]) -> list[Synthesis]:
        """The images of `requests`, their colours brought to those of the photographs.

        Images of one size are denoised together.

        Raises:
            InputError: where the scene has no depth at the nearest photograph.
        """
        conditions = [self.condition(r.nearest, r.target, r.context) for r in requests]
        first: dict[int, Tensor] = {}
        for group in grouped(conditions, self.at_once):
            images = self.painted([conditions[i] for i in group], self.seed)
            first.update(zip(group, images, strict=True))

        def answer(i: int) -> Synthesis:
            nearest, target = requests[i].nearest, requests[i].target

            def paint(seed: int) -> Float[Tensor, "h w 3"]:
                image = first[i] if seed == self.seed else self.painted([conditions[i]], seed)[0]
                back = resized(image, (target.height, target.width)).clamp(0, 1)
                return back.to(nearest.image.device)

            observed = warp_photographs(nearest, target, requests[i].context)
            correct = requests[i].context.correct_color
            return checked(paint, self.seed, observed, self.retries, correct)

        return [answer(i) for i in range(len(requests))]

    def condition(self, nearest: View, target: Camera, context: SceneContext) -> Condition:
        """What the model is told of a target; errors as those of `synthesize`."""
        size = self.model.size_for(target.height, target.width)
        source_size = self.model.size_for(nearest.camera.height, nearest.camera.width)
        grids = self.model.grid(source_size), self.model.grid(size)
        source = self.depth or source_depth_named(context.source_depth, self.device)
        depth = source(nearest, render_at(nearest, context))
        positions = source_ids(depth, nearest.camera, target, *grids).cpu()
        return Condition(resized(nearest.image, source_size), size, positions)

    def painted(self, conditions: Sequence[Condition], seed: int) -> Float[Tensor, "b h w 3"]:
        """An image for each condition. All are of one size, and so are their photographs."""
        size = conditions[0].size
        return self.model.generate(
            torch.stack([one.photograph for one in conditions]),
            size,
            target_ids(size, self.model.grid(size), self.ids_dtype),
            torch.stack([one.source_positions for one in conditions]),
            seed,
            self.steps,
            GUIDANCE,
        )


def preview(
    nearest: View,
    target: Camera,
    context: SceneContext,
    depth: SourceDepth = context_depth,
) -> Float[Tensor, "h w 3"]:
    """What the positions say: the pixels of the photograph where `target` sees them, over black.

    The model is not shown this picture. It is to be looked at: where it is displaced, or torn
    within a surface, the depth or the cameras are wrong, and the model is misled. Gaps beside what
    stands in front are right, and so is the smear at the border: there lies all that the target
    does not see.

    Raises:
        InputError: where the scene has no depth at the nearest photograph.
    """
    pixels, _ = seen_from(depth(nearest, render_at(nearest, context)), nearest.camera, target)
    return forward_splat(nearest.image, pixels, (target.height, target.width))


def grouped(conditions: Sequence[Condition], most: int) -> list[list[int]]:
    """Indices of conditions whose images and photographs have one size, at most `most` of them."""
    alike: dict[tuple[tuple[int, int], torch.Size], list[int]] = {}
    for i, one in enumerate(conditions):
        alike.setdefault((one.size, one.photograph.shape), []).append(i)
    return [
        indices[start : start + most]
        for indices in alike.values()
        for start in range(0, len(indices), most)
    ]


def render_at(view: View, context: SceneContext) -> Render:
    """The scene as the camera of `view`, one of the context's, sees it."""
    for known, render in zip(context.views, context.at_views, strict=True):
        if known is view or same_camera(known.camera, view.camera):
            return render
    raise InputError("The photograph to start from is none of the scene's; give one of its views.")


def load_pe_field(
    seed: int = 0, device: str = "cpu", settings: PEFieldSettings = PEFieldSettings()
) -> PEField:
    """PE-Field as the settings want it; an InputError where packages or weights are missing."""
    return PEField(
        load_kontext(settings.weights, device, settings.offload),
        seed,
        settings.steps,
        None if settings.depth is None else source_depth_named(settings.depth, device),
        device,
        retries=settings.retries,
        at_once=settings.batch_size,
    )
