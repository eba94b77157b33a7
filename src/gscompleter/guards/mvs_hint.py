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
from gscompleter.stages.select_context import select_context
from gscompleter.trust.photometric import (
    compute_trust,
    compute_trusted_alpha,
    gather_observations,
    sum_weights,
)
from gscompleter.types import Camera, GeneratorInput, Render, View

NUM_VIEWS = 3
"""Photographs that Ψ reconstructs; time grows with their number."""
MIN_ADVANTAGE = 0.1
"""Required advantage in trusted alpha over the scene."""


@dataclass(frozen=True)
class StereoRender:
    """Render of stereo among the photographs at a camera."""

    render: Render
    trusted_alpha: Float[Tensor, "h w"]
    """Alpha weighted by trust."""

    def find_better(
        self, trusted_alpha: Float[Tensor, "h w"], min_alpha: float
    ) -> Bool[Tensor, "h w"]:
        """Find pixels at which stereo is trusted enough, and more than the scene."""
        return (self.trusted_alpha >= min_alpha) & (
            self.trusted_alpha > trusted_alpha + MIN_ADVANTAGE
        )


def render_stereo(
    views: Sequence[View],
    camera: Camera,
    render: Render,
    reconstructor: Reconstructor,
    renderer: Renderer,
    config: TrustConfig,
) -> StereoRender | None:
    """Reconstruct the photographs that show most of a target, and render the result there.

    `render` shows the scene there. Returns None if the photographs determine no depth.
    """
    covered = render.depth_map().valid
    if len(views) < 2 or not covered.any():
        return None
    points = unproject(render.depth, camera)[covered]
    chosen = select_context([camera], [view.camera for view in views], points, NUM_VIEWS)
    try:
        scene, _ = init_context(reconstructor, [views[index] for index in chosen])
    except InputError:
        return None
    frozen_views = [renderer.freeze(scene, view.camera) for view in views]
    observations = gather_observations(scene, views, frozen_views, config)
    frozen = renderer.freeze(scene, camera)
    trust = compute_trust(observations, sum_weights(frozen), camera, config)
    return StereoRender(frozen.render, compute_trusted_alpha(frozen, trust))


def apply_stereo(context: GeneratorInput, stereo: StereoRender) -> GeneratorInput:
    """Replace the target render in the input of Φ where stereo is better."""
    if context.trusted_alpha is None:
        return context
    better = context.holes & stereo.find_better(context.trusted_alpha, context.max_alpha)
    scene, shown = context.target_render, stereo.render
    at_target = Render(
        torch.where(better[..., None], shown.image, scene.image),
        torch.where(better, shown.depth, scene.depth),
        torch.where(better, shown.alpha, scene.alpha),
    )
    trusted_alpha = torch.where(better, stereo.trusted_alpha, context.trusted_alpha)
    return replace(context, target_render=at_target, trusted_alpha=trusted_alpha)
