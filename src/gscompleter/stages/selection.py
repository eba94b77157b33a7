"""Which photographs the context is made of, where nobody says: those that matter to the targets.

The paper is given its two views. Of a whole capture most photographs show something else, and Ψ
takes a time that grows with their number. A photograph matters by what it shows of
what the targets see, from a direction like theirs; and depth comes of pairs, whose rays have to
meet at an angle: of two that stand in one place no depth can be told, and two that look from far
apart show different surfaces. So a set is worth, at each point that a target sees, what its best
pair is worth there. The best pair comes first, then always the one that adds most; where two
are needed to show what no pair shows yet, as for another target, each is worth half of that.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import inside, project
from gscompleter.types import Camera

MAX_POINTS = 1000
"""Points that are looked at, of all targets together."""
MAX_CANDIDATES = 32
"""Photographs that are compared pair by pair: those closest to the targets."""
MIN_POINTS = 20
"""A target that sees fewer is taken to see a plane in the middle of the scene."""
GRID = 8
"""Points of such a plane, along each side of the image."""
PLANES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Where planes lie that stand for a scene, in inverse depth from near to far."""
ASIDE = 5.0
"""Degrees between the directions of a photograph and of a target at a point, at which the worth
of the photograph has fallen to a half."""
ANGLE = 0.5
"""Degrees at which the rays of the best pair meet: some pixels of parallax."""
NARROWER, WIDER = 0.3, 20.0
"""Degrees less and more than that, at which the worth of a pair has fallen to a third."""
LEFT_OUT = 0.1
"""A point at which the best pair is worth less is shown by none."""
UNSEEN = 1e-3
"""What a photograph is worth at a point beyond its border: where nothing else is left, the one that
stands closest is the best."""


def select_context(
    targets: Sequence[Camera],
    candidates: Sequence[Camera],
    points: Float[Tensor, "n 3"],
    count: int,
) -> list[int]:
    """Indices of up to `count` of `candidates`, ascending.

    Args:
        targets: Cameras to complete the scene for, at least one.
        candidates: Cameras of photographs, in the frame of the targets.
        points: On or near the surfaces of the scene, in world coordinates; at least one.
        count: How many photographs are wanted.
    """
    share = max(MAX_POINTS // len(targets), 1)
    seen = [spread(sighted(target, points), share) for target in targets]
    worth = torch.cat([worths(t, candidates, p) for t, p in zip(targets, seen, strict=True)], dim=1)
    closest = worth.sum(1).argsort(descending=True, stable=True)[:MAX_CANDIDATES]
    rays = directions([candidates[i] for i in closest.tolist()], torch.cat(seen))
    chosen = greedy(worth[closest], rays, count)
    return sorted(closest[chosen].tolist())


def greedy(worth: Float[Tensor, "c p"], rays: Float[Tensor, "c p 3"], count: int) -> list[int]:
    """The best pair, then always the candidate that adds most to the best pairs at the points, now
    or with another one."""
    if min(count, len(worth)) < 2:
        return list(range(min(count, len(worth))))
    pairs = torch.stack([pair_worths(i, worth, rays) for i in range(len(worth))])
    first, second = divmod(int(pairs.sum(-1).argmax()), len(worth))
    chosen, best = [first, second], pairs[first, second]
    while len(chosen) < min(count, len(worth)):
        now = (pairs[chosen].amax(0) - best).clamp_min(0).sum(-1)
        later = (pairs.amax(0) * (best < LEFT_OUT)).sum(-1) / 2
        gains = torch.maximum(now, later) + UNSEEN * worth.sum(-1)
        gains[chosen] = -1.0
        added = int(gains.argmax())
        best = torch.maximum(best, pairs[chosen, added].amax(0))
        chosen.append(added)
    return chosen


def pair_worths(
    one: int, worth: Float[Tensor, "c p"], rays: Float[Tensor, "c p 3"]
) -> Float[Tensor, "c p"]:
    """What candidate `one` and each other are worth together at each point."""
    excess = angles(rays[one], rays) - ANGLE
    width = torch.where(excess < 0, NARROWER, WIDER)
    together = torch.minimum(worth[one], worth) * torch.exp(-((excess / width) ** 2))
    same_place = (rays[one] == rays).all(-1)
    return together.masked_fill(same_place, 0.0)


def worths(
    target: Camera, candidates: Sequence[Camera], points: Float[Tensor, "p 3"]
) -> Float[Tensor, "c p"]:
    """What each candidate is worth at points that the target sees, by itself."""
    apart = angles(directions([target], points)[0], directions(candidates, points))
    shown = torch.stack([inside(*project(points, c), c) for c in candidates])
    return torch.where(shown, 1.0, UNSEEN) / (1 + (apart / ASIDE) ** 2)


def sighted(target: Camera, points: Float[Tensor, "n 3"]) -> Float[Tensor, "p 3"]:
    """Those of `points` that the target sees, or where these are few, a plane before it."""
    seen = points[inside(*project(points, target), target)]
    if len(seen) >= MIN_POINTS:
        return seen
    return plane_before(target, (points - target.center).norm(dim=-1).median().item())


def points_before(target: Camera, near: float, far: float) -> Float[Tensor, "p 3"]:
    """Points that stand for a scene of which nothing but its range of z-depth, in scene units, is
    known: on planes before a target, as far apart as its image tells depths apart."""
    inverse = [(1 - share) / near + share / far for share in PLANES]
    return torch.cat([plane_before(target, 1 / value) for value in inverse])


def plane_before(target: Camera, depth: float) -> Float[Tensor, "p 3"]:
    """Points at a z-depth, in scene units, all over the image of a target."""
    rays = target.z_rays()
    rows, columns = (
        torch.linspace(0, side - 1, GRID).round().long() for side in (target.height, target.width)
    )
    return target.center + depth * rays[rows][:, columns].reshape(-1, 3)


def spread(points: Float[Tensor, "n 3"], count: int) -> Float[Tensor, "m 3"]:
    """At most `count` of `points`, every n-th."""
    return points[:: -(-len(points) // count)]


def directions(cameras: Sequence[Camera], points: Float[Tensor, "p 3"]) -> Float[Tensor, "c p 3"]:
    """Unit vectors from each camera's centre to each point."""
    centers = torch.stack([camera.center for camera in cameras])
    return torch.nn.functional.normalize((points - centers[:, None]).double(), dim=-1)


def angles(a: Float[Tensor, "*#shape 3"], b: Float[Tensor, "*#shape 3"]) -> Float[Tensor, "*shape"]:
    """Degrees between unit vectors. Half of their difference keeps small angles exact."""
    return torch.rad2deg(2 * torch.asin(((a - b).norm(dim=-1) / 2).clamp_max(1.0)))
