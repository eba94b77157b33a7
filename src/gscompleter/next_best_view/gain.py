"""Next-best view: score candidate cameras and choose among them.

The gain is the image fraction of holes near observed pixels (farther away anything could be there)
and of distrust elsewhere, times the overlap with the anchor. Among similar gains, the camera
nearest to the photographs wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import NextBestViewConfig
from gscompleter.geometry import (
    compute_field_of_view,
    measure_baseline,
    measure_rotation,
    unproject,
)
from gscompleter.image_ops import dilate, fill_smoothly
from gscompleter.next_best_view.candidates import Candidate
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, choose_thinned_rows, thin_gaussians
from gscompleter.state import Completion
from gscompleter.types import Camera, ContextScene, Gaussians, Render, make_observed


@dataclass(frozen=True)
class Choice:
    """A candidate with its score."""

    candidate: Candidate
    hole_fraction: float
    """Fraction of its image in holes."""
    gain: float
    """Expected gain, as a fraction of its image."""

    @property
    def camera(self) -> Camera:
        """Camera of the candidate."""
        return self.candidate.camera

    def is_near(self, other: Candidate, step: float) -> bool:
        """Return True if another candidate is at most one step away, as in `choose_best`."""
        return compute_remoteness(other.camera, [self.camera], step) <= 1


def compute_gain(
    holes: Bool[Tensor, "h w"],
    distrust: Float[Tensor, "h w"],
    overlap: float,
    config: NextBestViewConfig = NextBestViewConfig(),
) -> float:
    """Compute the gain of completing an image, as a fraction of the image.

    Pixels outside of `holes` count by the square of their `distrust` in [0, 1], since a little of
    it is everywhere. `overlap` is the fraction of the observed part that the anchor sees, too.
    """
    radius = max(round(config.border_radius * max(holes.shape)), 1)
    bordering = holes & dilate(~holes, radius)
    return torch.where(holes, bordering.float(), distrust**2).mean().item() * overlap


def choose_best(
    choices: Sequence[Choice],
    photographs: Sequence[Camera],
    step: float,
    config: NextBestViewConfig = NextBestViewConfig(),
) -> Choice | None:
    """Choose the camera to complete next, or None if little is left; `step` is in scene units."""
    most = max((choice.gain for choice in choices), default=0.0)
    if most < config.min_gain:
        return None
    good = [choice for choice in choices if choice.gain >= config.enough * most]

    def order(choice: Choice) -> tuple[int, float]:
        return round(compute_remoteness(choice.camera, photographs, step)), -choice.gain

    return min(good, key=order)


def compute_remoteness(camera: Camera, photographs: Sequence[Camera], step: float) -> float:
    """Compute the distance to the nearest photograph in steps; a quarter field of view is one."""
    quarter = torch.rad2deg(torch.tensor(min(compute_field_of_view(camera)) / 4)).item()
    return min(
        measure_baseline(camera, other) / max(step, 1e-30)
        + measure_rotation(camera, other) / quarter
        for other in photographs
    )


def make_placeholders(render: Render, holes: Bool[Tensor, "h w"], camera: Camera) -> Gaussians:
    """Make grey Gaussians that close holes at the smoothly extrapolated depth around them."""
    seen = render.depth_map()
    depth = fill_smoothly(seen.depth, seen.valid & ~holes)
    means = unproject(depth, camera)[holes]
    size = (0.7 * depth / camera.K[0, 0])[holes]
    quats = torch.eye(4).to(means)[:1].repeat(len(means), 1)
    return make_observed(
        means,
        quats,
        size[:, None].repeat(1, 3),
        torch.full_like(size, 0.99),
        torch.zeros((len(means), 1, 3)).to(means),
    )


def simplify_completion(completion: Completion, most: int = MAX_PREVIEW_GAUSSIANS) -> Completion:
    """Simplify a completion for small images, with its trust."""
    rows, growth = choose_thinned_rows(completion.parts[0], most)
    context = thin_gaussians(completion.parts[0], most)
    parts = (context, thin_gaussians(completion.added, most))
    trust = completion.trust.thin(rows, growth)
    return replace(completion, source=ContextScene.whole(context), parts=parts, trust=trust)
