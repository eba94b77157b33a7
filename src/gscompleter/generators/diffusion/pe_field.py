"""PE-Field: a diffusion transformer that reads the photograph at the target camera's positions.

The model is told by nothing but positions how the camera moved: every token of the photograph
stands where the target camera sees what it shows. Holes are filled through attention alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.generators.agreement import AgreementConfig, checked
from gscompleter.generators.diffusion.kontext import Kontext, resized
from gscompleter.generators.diffusion.position_ids import source_ids, target_ids
from gscompleter.generators.diffusion.source_depth import SourceDepth, context_depth
from gscompleter.generators.warp_inpaint.warp import warp_photographs
from gscompleter.geometry import same_camera
from gscompleter.types import Camera, Render, SceneContext, View


@dataclass(frozen=True)
class PEField:
    """Φ of the paper. `load_kontext` gives the model."""

    model: Kontext
    """FLUX Kontext with per-head positions."""
    seed: int = 0
    """Of the noise; the same seed gives the same image on the same device."""
    steps: int = 4
    """Evaluations of the transformer. The paper takes 4, the authors' own demonstration 28."""
    guidance: float = 3.5
    """Scale of the distilled guidance."""
    depth: SourceDepth = context_depth
    """Depth of the photograph: of the scene itself, or `MonocularDepth`."""
    ids_dtype: torch.dtype = torch.bfloat16
    """What positions of the target are rounded to: bfloat16 as in the authors' run."""
    agreement: AgreementConfig = AgreementConfig()
    """How the image is compared with what the photographs show."""

    def __call__(
        self, nearest: View, target: Camera, context: SceneContext
    ) -> Float[Tensor, "h w 3"]:
        """The image `target` would take, in [0, 1].

        Raises:
            InputError: where the scene has no depth at the nearest photograph.
        """
        return self.with_notes(nearest, target, context)[0]

    def with_notes(
        self, nearest: View, target: Camera, context: SceneContext
    ) -> tuple[Float[Tensor, "h w 3"], tuple[str, ...]]:
        """The image, its colours brought to those of the photographs, and what to know of it."""
        size = self.model.size_for(target.height, target.width)
        source_size = self.model.size_for(nearest.camera.height, nearest.camera.width)
        grid, source_grid = self.model.grid(size), self.model.grid(source_size)
        depth = self.depth(nearest, render_at(nearest, context))
        photograph = resized(nearest.image, source_size)
        of_target = target_ids(size, grid, self.ids_dtype)
        of_source = source_ids(depth, nearest.camera, target, source_grid, grid).cpu()

        def paint(seed: int) -> Float[Tensor, "h w 3"]:
            image = self.model.generate(
                photograph, size, of_target, of_source, seed, self.steps, self.guidance
            )
            back = resized(image, (target.height, target.width)).clamp(0, 1)
            return back.to(nearest.image.device)

        observed = warp_photographs(nearest, target, context)
        return checked(paint, self.seed, observed, self.agreement)


def render_at(view: View, context: SceneContext) -> Render:
    """The scene as the camera of `view`, one of the context's, sees it."""
    for known, render in zip(context.views, context.at_views, strict=True):
        if known is view or same_camera(known.camera, view.camera):
            return render
    raise InputError("The photograph to start from is none of the scene's; give one of its views.")
