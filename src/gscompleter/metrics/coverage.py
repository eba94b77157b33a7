"""Coverage: share of pixels with alpha of at least 0.5, over held-out cameras.

The cameras are random, close to the path of the context cameras and rotated by some degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch

from gscompleter.coverage import COVERED
from gscompleter.frames.thinning import thinned
from gscompleter.geometry import baseline_between, rotation_about, share_of_turn
from gscompleter.render import Renderer, each_view
from gscompleter.stages.candidates import moved, shrunk, spacing
from gscompleter.stages.exploration import MAX_GAUSSIANS
from gscompleter.types import Camera, Completion, Render, merge

NUM_CAMERAS = 32
SIDE = 96
"""Longer side of the rendered images, in pixels."""
TURN = 5.0
"""Standard deviation of yaw and pitch, in degrees."""


@dataclass(frozen=True)
class Coverage:
    """Share of pixels that the scene covers, before and after completion."""

    before: float
    after: float
    cameras: int
    """Number of cameras."""

    def as_summary(self) -> dict[str, float]:
        """Return the entry of `summary.json`."""
        return asdict(self)


@dataclass(frozen=True)
class Look:
    """Renders of one camera before and after completion."""

    before: Render
    after: Render


def looks_of(completion: Completion, cameras: Sequence[Camera], renderer: Renderer) -> list[Look]:
    """Render the scene before and after completion in small images, from a thinned scene."""
    begun = thinned(completion.drawn_context, MAX_GAUSSIANS)
    aside = completion.set_aside is not None
    kept = thinned(completion.drawn[: completion.num_kept], MAX_GAUSSIANS) if aside else begun
    added = [thinned(result.added, MAX_GAUSSIANS) for result in completion.targets]
    new = merge([begun[:0], *added])

    def render_pair(camera: Camera) -> Look:
        first = renderer.freeze(begun, camera)
        last = renderer.freeze(kept, camera) if aside else first
        return Look(first.context, last.composite(new))

    return list(each_view(new)(render_pair, [shrunk(camera, SIDE) for camera in cameras]))


def coverage_of(looks: Sequence[Look]) -> Coverage:
    """Compute the coverage before and after completion."""
    before, after = [look.before for look in looks], [look.after for look in looks]
    return Coverage(covered(before), covered(after), len(looks))


def covered(renders: Sequence[Render]) -> float:
    """Compute the share of pixels of all renders that the scene covers."""
    return torch.cat([r.alpha.flatten() >= COVERED for r in renders]).float().mean().item()


def held_out_cameras(
    cameras: Sequence[Camera], seed: int, count: int = NUM_CAMERAS
) -> list[Camera]:
    """Sample cameras around the path of `cameras`; the same seed gives the same cameras."""
    generator = torch.Generator().manual_seed(seed)
    step = spacing(cameras)
    return [held_out(cameras, step, generator) for _ in range(count)]


def held_out(cameras: Sequence[Camera], step: float, generator: torch.Generator) -> Camera:
    """Sample a camera between a random one of `cameras` and its nearest neighbour."""
    first = cameras[int(torch.randint(len(cameras), (), generator=generator))]
    share = torch.rand((), generator=generator).item()
    shift = step * torch.randn(3, generator=generator) / 3**0.5
    right, down = (TURN * torch.randn(2, generator=generator)).tolist()
    between = interpolated(first, neighbour(first, cameras), share)
    turn = rotation_about(between.c2w[:3, 1], math.radians(right))
    turn = rotation_about(between.c2w[:3, 0], math.radians(down)) @ turn
    return moved(between, turn, shift.to(between.c2w))


def neighbour(camera: Camera, cameras: Sequence[Camera]) -> Camera:
    """Return the camera nearest to `camera`, or `camera` itself if there is no other."""
    others = [other for other in cameras if other is not camera]
    return min(others, key=lambda other: baseline_between(camera, other), default=camera)


def interpolated(first: Camera, second: Camera, share: float) -> Camera:
    """Interpolate from `first` to the pose of `second`."""
    turn = second.c2w[:3, :3].double() @ first.c2w[:3, :3].double().T
    return moved(
        first, share_of_turn(turn, share).to(first.c2w), share * (second.center - first.center)
    )
