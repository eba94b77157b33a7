"""Coverage: share of pixels whose trusted alpha is at least `COVERED`, over held-out cameras.

The cameras are random, near the path of the context cameras, rotated by some degrees. Under full
trust, trusted alpha is alpha; of a trained splat it counts what photographs confirm, and afterwards
what was added or recoloured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import (
    axis_angle_to_matrix,
    compute_spacing,
    interpolate_camera,
    measure_baseline,
    move_camera,
    shrink_camera,
)
from gscompleter.render.lod import MAX_PREVIEW_GAUSSIANS, choose_thinned_rows, thin_gaussians
from gscompleter.render.protocols import FrozenScene, Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.state import Completion
from gscompleter.trust import Trust
from gscompleter.trust.photometric import PhotometricTrust
from gscompleter.types import Camera, Render, merge

NUM_COVERAGE_CAMERAS = 32
"""Held-out cameras, unless a caller gives another number."""
COVERAGE_SIDE = 96
"""Longer side of the rendered images, in pixels."""
TURN_DEGREES = 5.0
"""Standard deviation of yaw and pitch, in degrees."""


@dataclass(frozen=True)
class Coverage:
    """Share of pixels that the scene covers with trust, before and after completion."""

    before: float
    after: float
    cameras: int


@dataclass(frozen=True)
class RenderPair:
    """Renders of one camera before and after completion, with trusted alpha."""

    before: Render
    after: Render


def render_pairs(
    completion: Completion, cameras: Sequence[Camera], renderer: Renderer
) -> list[RenderPair]:
    """Render the scene before and after completion in small images, from a thinned scene."""
    # The context as it is rendered; recolouring and removal replace it.
    is_unchanged = completion.rendered_context is completion.source.rendered
    begun = thin_gaussians(completion.source.rendered, MAX_PREVIEW_GAUSSIANS)
    kept = (
        begun
        if is_unchanged
        else thin_gaussians(completion.rendered_context, MAX_PREVIEW_GAUSSIANS)
    )
    added = [thin_gaussians(result.added, MAX_PREVIEW_GAUSSIANS) for result in completion.targets]
    new = merge([begun[:0], *added])

    # Trust has values for each Gaussian, and is thinned by the same rows. Before the completion,
    # nothing was recoloured.
    trust = completion.trust.thin(
        *choose_thinned_rows(completion.rendered_context, MAX_PREVIEW_GAUSSIANS)
    )
    at_first = trust
    if isinstance(trust, PhotometricTrust):
        at_first = replace(trust, is_recolored=torch.zeros_like(trust.is_recolored))

    def render_pair(camera: Camera) -> RenderPair:
        first = renderer.freeze(begun, camera)
        last = (first if kept is begun else renderer.freeze(kept, camera)).extend(new)
        return RenderPair(
            render_trusted(first, at_first, camera), render_trusted(last, trust, camera)
        )

    return list(
        get_view_map(new.means)(
            render_pair, [shrink_camera(camera, COVERAGE_SIDE) for camera in cameras]
        )
    )


def render_trusted(frozen: FrozenScene, trust: Trust, camera: Camera) -> Render:
    """Render a frozen scene with its alpha weighted by trust."""
    return replace(frozen.render, alpha=trust.compute_alpha(frozen, camera))


def compute_coverage(pairs: Sequence[RenderPair]) -> Coverage:
    """Compute the coverage before and after completion, and count the cameras."""
    before = [pair.before for pair in pairs]
    after = [pair.after for pair in pairs]
    return Coverage(compute_covered_share(before), compute_covered_share(after), len(pairs))


def compute_covered_share(renders: Sequence[Render]) -> float:
    """Compute the share of pixels of all renders whose alpha is high enough."""
    return torch.cat([r.alpha.flatten() >= COVERED for r in renders]).float().mean().item()


def sample_held_out_cameras(
    cameras: Sequence[Camera], seed: int, count: int = NUM_COVERAGE_CAMERAS
) -> list[Camera]:
    """Sample cameras around the path of `cameras`; the same seed gives the same cameras."""
    generator = torch.Generator().manual_seed(seed)
    step = compute_spacing(cameras)
    return [sample_held_out_camera(cameras, step, generator) for _ in range(count)]


def sample_held_out_camera(
    cameras: Sequence[Camera], step: float, generator: torch.Generator
) -> Camera:
    """Sample a camera between a random one of `cameras` and its nearest neighbour.

    It is shifted in all directions and turned; `step` is in scene units.
    """
    first = cameras[int(torch.randint(len(cameras), (), generator=generator))]
    share = torch.rand((), generator=generator).item()
    # The step is the spacing of the cameras; the mean squared length of the shift is step².
    shift = step * torch.randn(3, generator=generator) / 3**0.5
    yaw, pitch = (TURN_DEGREES * torch.randn(2, generator=generator)).tolist()
    others = [other for other in cameras if other is not first]
    nearest = min(others, key=lambda other: measure_baseline(first, other), default=first)
    between = interpolate_camera(first, nearest, share)
    # About the down and the right axis of the camera (OpenCV), in world axes.
    turn = axis_angle_to_matrix(between.c2w[:3, 1], math.radians(yaw))
    turn = axis_angle_to_matrix(between.c2w[:3, 0], math.radians(pitch)) @ turn
    return move_camera(between, turn, shift.to(between.c2w))
