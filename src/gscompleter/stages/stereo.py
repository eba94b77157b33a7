"""MVS hint: stereo among the photographs where an input splat is wrong.

Training may fail even where photographs exist. There Φ gets the render of Ψ's reconstruction of the
photographs instead, if they confirm it better.
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
"""Photographs that Ψ reconstructs; time grows with their number."""
BETTER = 0.1
"""Required advantage in trusted alpha over the scene."""


@dataclass(frozen=True)
class Stereo:
    """Render of stereo among the photographs at a camera."""

    render: Render
    support: Float[Tensor, "h w"]
    """Alpha weighted by trust."""

    def better(self, believed: Float[Tensor, "h w"], min_alpha: float) -> Bool[Tensor, "h w"]:
        """Find pixels at which stereo is trusted enough, and more than the scene."""
        return (self.support >= min_alpha) & (self.support > believed + BETTER)


def stereo_among(
    views: Sequence[View],
    camera: Camera,
    drawn: Render,
    reconstructor: Reconstructor,
    renderer: Renderer,
    config: TrustConfig,
) -> Stereo | None:
    """Reconstruct the photographs that show most of a target, and render the result there.

    `render` shows the scene there. Returns None if the photographs determine no depth.
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
    observations = gather_evidence(scene, views, frozen_views, config)
    frozen = renderer.freeze(scene, camera)
    trust = support(observations, weight_sums(frozen), camera, config)
    return Stereo(frozen.context, believed_alpha(frozen, trust))


def corrected(context: SceneContext, stereo: Stereo) -> SceneContext:
    """Replace the target render in the input of Φ where stereo is better."""
    if context.believed is None:
        return context
    better = context.holes & stereo.better(context.believed, context.max_alpha)
    scene, shown = context.at_target, stereo.render
    at_target = Render(
        torch.where(better[..., None], shown.image, scene.image),
        torch.where(better, shown.depth, scene.depth),
        torch.where(better, shown.alpha, scene.alpha),
    )
    trusted_alpha = torch.where(better, stereo.support, context.believed)
    return replace(context, at_target=at_target, believed=trusted_alpha)
