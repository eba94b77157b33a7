"""What stereo among the photographs shows, where a scene that was brought shows it wrongly.

Training may fail where photographs do look, and a photograph may never have been trained on. There
nothing has to be imagined: Ψ makes Gaussians of the photographs that see most of what the target
sees. They are held against the photographs as the scene is, and taken where they do better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import TrustConfig
from gscompleter.errors import InputError
from gscompleter.geometry import unproject
from gscompleter.reconstructors import Reconstructor
from gscompleter.render import Renderer
from gscompleter.stages.context import init_context
from gscompleter.stages.selection import select_context
from gscompleter.stages.support import believed_alpha, gather_evidence, support, weight_sums
from gscompleter.types import Camera, Render, SceneContext, View

NUM_VIEWS = 3
"""Photographs that stereo is made of: its time grows with their number."""
BETTER = 0.1
"""By how much more the photographs have to support it, so that it takes the place of the scene."""


@dataclass(frozen=True)
class Stereo:
    """What stereo among photographs shows to a camera."""

    render: Render
    support: Float[Tensor, "h w"]
    """Its alpha, as far as the photographs support it."""

    def better(self, believed: Float[Tensor, "h w"], min_alpha: float) -> Bool[Tensor, "h w"]:
        """Where it is worth more than a scene of which this much is believed."""
        return (self.support >= min_alpha) & (self.support > believed + BETTER)


def stereo_among(
    views: Sequence[View],
    camera: Camera,
    drawn: Render,
    reconstructor: Reconstructor,
    renderer: Renderer,
    config: TrustConfig,
) -> Stereo | None:
    """What Ψ makes of those of `views` that matter to `camera`; None where they tell no depth.

    Args:
        views: Photographs, with the depth range.
        camera: Who asks.
        drawn: The scene as `camera` sees it, which tells about where things are.
        reconstructor: Ψ.
        renderer: Draws what it makes.
        config: How different from a photograph is too different.
    """
    covered = drawn.depth_map().valid
    if len(views) < 2 or not covered.any():
        return None
    points = unproject(drawn.depth, camera)[covered]
    chosen = select_context([camera], [view.camera for view in views], points, NUM_VIEWS)
    try:
        scene, _ = init_context(reconstructor, [views[index] for index in chosen])
    except InputError:
        return None
    frozen_views = [renderer.freeze(scene, view.camera) for view in views]
    evidence = gather_evidence(scene, views, frozen_views, config)
    frozen = renderer.freeze(scene, camera)
    values = support(evidence, weight_sums(frozen), camera, config)
    return Stereo(frozen.context, believed_alpha(frozen, values))


def corrected(context: SceneContext, stereo: Stereo) -> SceneContext:
    """What Φ is told of a scene, with what stereo shows where that is better."""
    if context.believed is None:
        return context
    better = context.holes & stereo.better(context.believed, context.max_alpha)
    scene, shown = context.at_target, stereo.render
    at_target = Render(
        torch.where(better[..., None], shown.image, scene.image),
        torch.where(better, shown.depth, scene.depth),
        torch.where(better, shown.alpha, scene.alpha),
    )
    believed = torch.where(better, stereo.support, context.believed)
    return replace(context, at_target=at_target, believed=believed)
