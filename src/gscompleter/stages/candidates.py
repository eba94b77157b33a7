"""Where a scene may be completed from, where nobody says: cameras a move away from the photographs.

The moves are those of ExploreGS around each training camera: six translations, four turns, and
four orbits about what the camera looks at. A step is as long as the photographs stand apart, and no
longer than a share of the depth they see, so that most of what a candidate sees was observed. No
move tilts the horizon more than the photographs do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.config import NextBestViewConfig
from gscompleter.geometry import project, rotation_about
from gscompleter.types import Camera, Render

MARGIN = 0.1
"""Share of its depth by which a point has to lie before a surface to be in the open."""
MIN_SEEN = 0.05
"""Share of its image of which a camera must see the scene for its depth to be known."""


@dataclass(frozen=True)
class Candidate:
    """A camera that the scene may be completed for."""

    camera: Camera
    base: int
    """Index of the given camera that it was derived from."""
    nearest: float
    """z-depth of the nearest twentieth of what that camera sees, in scene units."""


def candidates(
    bases: Sequence[Camera],
    renders: Sequence[Render],
    step: float,
    config: NextBestViewConfig = NextBestViewConfig(),
) -> list[Candidate]:
    """The moves of each of `bases` that end in free space.

    Args:
        bases: Cameras of photographs.
        renders: What these see of the scene, in images of any size.
        step: How far a camera moves at most, in scene units; 0 where the photographs do not tell.
        config: How far it moves otherwise.
    """
    depths, nearest = depths_at(renders, 0.5), depths_at(renders, 0.05)
    up = upward(bases)
    found = []
    for index, (base, depth) in enumerate(zip(bases, depths, strict=True)):
        longest = config.max_step * depth
        away = moves(
            base, depth, min(step, longest) if step > 0 else longest, config.yaw_fraction, up
        )
        found += [Candidate(camera, index, nearest[index]) for camera in away]
    small = [resized(b, *r.alpha.T.shape) for b, r in zip(bases, renders, strict=True)]
    return [c for c in found if in_the_open(c.camera.center, small, renders)]


def moves(
    camera: Camera, depth: float, step: float, turn: float, up: Float[Tensor, "3"]
) -> list[Camera]:
    """Fourteen cameras a move away from `camera`.

    Args:
        camera: Where the moves begin.
        depth: z-depth of what it looks at, in scene units.
        step: Length of a translation, and about that of the arc of an orbit, in scene units.
        turn: Angle of a turn, as a share of the opening angle.
        up: The direction that turns to the side turn about [3], of length 1.
    """
    axes = camera.c2w[:3, :3].T
    shifts = [sign * step * axis for axis in axes for sign in (1, -1)]
    translated = [moved(camera, torch.eye(3).to(up), shift) for shift in shifts]
    ahead = camera.center + depth * camera.forward
    wide, high = opening(camera)
    return [
        *translated,
        *swung(camera, camera.center, (turn * wide, turn * high), up),
        *swung(camera, ahead, (step / depth, step / depth), up),
    ]


def swung(
    camera: Camera, pivot: Float[Tensor, "3"], angles: tuple[float, float], up: Float[Tensor, "3"]
) -> list[Camera]:
    """`camera` turned about a point to either side, about `up`, and up and down, about its own
    x-axis; by so many radians."""
    axes = (up, camera.c2w[:3, 0])
    arm = camera.center - pivot
    turns = [
        rotation_about(axis, sign * angle)
        for axis, angle in zip(axes, angles, strict=True)
        for sign in (1, -1)
    ]
    return [moved(camera, turn, turn @ arm - arm) for turn in turns]


def moved(camera: Camera, turn: Float[Tensor, "3 3"], shift: Float[Tensor, "3"]) -> Camera:
    """`camera` turned in world axes, its centre moved by `shift`."""
    c2w = camera.c2w.clone()
    c2w[:3, :3] = turn @ camera.c2w[:3, :3]
    c2w[:3, 3] += shift
    return replace(camera, c2w=c2w)


def opening(camera: Camera) -> tuple[float, float]:
    """Opening angles of a camera to the side and upwards, in radians."""
    half = torch.tensor([camera.width, camera.height]) / 2 / camera.K.diagonal()[:2].cpu()
    wide, high = (2 * torch.atan(half)).tolist()
    return wide, high


def upward(cameras: Sequence[Camera]) -> Float[Tensor, "3"]:
    """The direction that is up in most of the images, of length 1."""
    ups = torch.stack([-camera.c2w[:3, 1] for camera in cameras])
    likeness = (ups @ ups.T).sum(dim=1)
    return normalize(ups[(ups @ ups[likeness.argmax()]) > 0].mean(dim=0), dim=0)


def in_the_open(
    point: Float[Tensor, "3"], cameras: Sequence[Camera], renders: Sequence[Render]
) -> bool:
    """Whether a photograph sees through `point`, or at least none sees a surface before it."""
    hidden = False
    for camera, render in zip(cameras, renders, strict=True):
        pixel, z = project(point, camera)
        x, y = (int(value) for value in pixel.clamp(-1, 1e6).floor())
        if z <= 0 or not (0 <= x < camera.width and 0 <= y < camera.height):
            continue
        surface = render.depth_map()
        if not surface.valid[y, x]:
            continue
        if z < (1 - MARGIN) * surface.depth[y, x]:
            return True
        hidden = True
    return not hidden


def is_close(render: Render, nearest: float, config: NextBestViewConfig) -> bool:
    """Whether surfaces before a camera fill more of its image than they may; `nearest` is how near,
    in scene units, they are where a photograph was taken."""
    seen = render.depth_map()
    near = seen.valid & (seen.depth < config.clearance * nearest)
    return near.float().mean().item() > config.max_close


def depths_at(renders: Sequence[Render], share: float) -> list[float]:
    """The z-depth, in scene units, before which a share of what each render shows lies; of one that
    shows next to nothing, that of all.

    Raises:
        ValueError: where none shows anything.
    """
    valid = [render.depth_map().valid for render in renders]
    own = [render.depth[where] for render, where in zip(renders, valid, strict=True)]
    if sum(len(values) for values in own) == 0:
        raise ValueError("no camera sees the scene, so that nothing tells how far away it is")
    usual = torch.cat(own).quantile(share).item()
    known = [where.float().mean().item() >= MIN_SEEN for where in valid]
    return [v.quantile(share).item() if k else usual for v, k in zip(own, known, strict=True)]


def shrunk(camera: Camera, side: int) -> Camera:
    """`camera` with an image of at most `side` pixels along its longer side."""
    factor = min(side / max(camera.width, camera.height), 1.0)
    return resized(camera, *(max(round(factor * n), 1) for n in (camera.width, camera.height)))


def resized(camera: Camera, width: int, height: int) -> Camera:
    """`camera` with an image of another size, in pixels."""
    scale = torch.tensor([width / camera.width, height / camera.height, 1.0]).to(camera.K)
    return replace(camera, K=scale[:, None] * camera.K, width=width, height=height)


def spread_cameras(cameras: Sequence[Camera], count: int) -> list[int]:
    """Indices of up to `count` cameras that lie far apart: the first, then always the one that
    stands and looks most unlike those before."""
    where = places(cameras)
    chosen = [0]
    apart = (where - where[0]).norm(dim=1)
    while len(chosen) < min(count, len(cameras)):
        chosen.append(int(apart.argmax()))
        apart = torch.minimum(apart, (where - where[chosen[-1]]).norm(dim=1))
        apart[chosen] = -1.0
    return chosen


def places(cameras: Sequence[Camera]) -> Float[Tensor, "n 6"]:
    """Where cameras stand, relative to how far they spread, and the directions they look in."""
    centers = torch.stack([camera.center for camera in cameras])
    extent = (centers - centers.mean(dim=0)).norm(dim=1).max().clamp_min(1e-30)
    return torch.cat([centers / extent, torch.stack([c.forward for c in cameras])], dim=1)


def spacing(cameras: Sequence[Camera]) -> float:
    """How far cameras stand from their nearest neighbours in the median, in scene units; 0 where
    most of them share their place."""
    centers = torch.stack([camera.center for camera in cameras]).double()
    apart = (centers[:, None] - centers).norm(dim=-1)
    apart.fill_diagonal_(torch.inf)
    nearest = apart.amin(dim=1)
    return nearest.median().item() if len(cameras) > 1 else 0.0
