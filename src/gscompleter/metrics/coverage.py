"""How much of what can be looked at a scene covers: the share of pixels with alpha of at least a
half, over cameras around the path of the photographs that nothing was completed for.

Such a camera lies at random between a photograph's camera and its nearest neighbour, moved aside by
about as much as these stand apart, and turned by some degrees.
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
"""Pixels of the longer side of the images that are looked at."""
TURN = 5.0
"""Standard deviation, in degrees, of the turns to the side and up and down."""


@dataclass(frozen=True)
class Coverage:
    """Share of the pixels that the scene covers, before and after it was completed."""

    before: float
    after: float
    cameras: int
    """How many cameras it was looked at from."""

    def as_summary(self) -> dict[str, float]:
        """As `summary.json` has it."""
        return asdict(self)


@dataclass(frozen=True)
class Look:
    """What one camera sees of a scene in a small image, before and after it was completed."""

    before: Render
    after: Render


def looks_of(completion: Completion, cameras: Sequence[Camera], renderer: Renderer) -> list[Look]:
    """What `cameras` see of the scene in small images, about."""
    begun = thinned(completion.drawn_context, MAX_GAUSSIANS)
    aside = completion.set_aside is not None
    kept = thinned(completion.drawn[: completion.num_kept], MAX_GAUSSIANS) if aside else begun
    added = [thinned(result.added, MAX_GAUSSIANS) for result in completion.targets]
    new = merge([begun[:0], *added])

    def look(camera: Camera) -> Look:
        first = renderer.freeze(begun, camera)
        last = renderer.freeze(kept, camera) if aside else first
        return Look(first.context, last.composite(new))

    return list(each_view(new)(look, [shrunk(camera, SIDE) for camera in cameras]))


def coverage_of(looks: Sequence[Look]) -> Coverage:
    """How much a scene covers of what was looked at."""
    before, after = [look.before for look in looks], [look.after for look in looks]
    return Coverage(covered(before), covered(after), len(looks))


def covered(renders: Sequence[Render]) -> float:
    """Share of the pixels of all renders that the scene covers."""
    return torch.cat([r.alpha.flatten() >= COVERED for r in renders]).float().mean().item()


def held_out_cameras(
    cameras: Sequence[Camera], seed: int, count: int = NUM_CAMERAS
) -> list[Camera]:
    """Cameras around the path of `cameras`, the same ones for the same seed."""
    generator = torch.Generator().manual_seed(seed)
    step = spacing(cameras)
    return [held_out(cameras, step, generator) for _ in range(count)]


def held_out(cameras: Sequence[Camera], step: float, generator: torch.Generator) -> Camera:
    """A camera between one of `cameras` and its nearest neighbour, moved and turned at random."""
    first = cameras[int(torch.randint(len(cameras), (), generator=generator))]
    share = torch.rand((), generator=generator).item()
    shift = step * torch.randn(3, generator=generator) / 3**0.5
    right, down = (TURN * torch.randn(2, generator=generator)).tolist()
    between = interpolated(first, neighbour(first, cameras), share)
    turn = rotation_about(between.c2w[:3, 1], math.radians(right))
    turn = rotation_about(between.c2w[:3, 0], math.radians(down)) @ turn
    return moved(between, turn, shift.to(between.c2w))


def neighbour(camera: Camera, cameras: Sequence[Camera]) -> Camera:
    """The camera that stands nearest to `camera`; itself where there is no other."""
    others = [other for other in cameras if other is not camera]
    return min(others, key=lambda other: baseline_between(camera, other), default=camera)


def interpolated(first: Camera, second: Camera, share: float) -> Camera:
    """`first` on its way to where `second` stands and looks."""
    turn = second.c2w[:3, :3].double() @ first.c2w[:3, :3].double().T
    return moved(
        first, share_of_turn(turn, share).to(first.c2w), share * (second.center - first.center)
    )
