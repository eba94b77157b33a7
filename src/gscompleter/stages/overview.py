"""Which photographs the context is made of where no target is named, so that all of the scene
matters: such as are spread over all places and directions, each with another that sees the same.

Of a walk through a scene that is every n-th photograph. One that shares too little with the others
for stereo brings along a photograph that makes the best pair with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import inside, project
from gscompleter.stages.candidates import places, spread_cameras
from gscompleter.stages.selection import (
    MAX_POINTS,
    angles,
    directions,
    pair_worths,
    sighted,
    spread,
    worths,
)
from gscompleter.types import Camera

MAX_OVERVIEW = 16
"""Photographs that stand for all that is to be seen."""
NUM_ROUNDS = 20
"""How often photographs move to the middle of those that they stand for, at most."""
MIN_SHARED = 0.3
"""Share of the points seen that another camera must see, too, for the two to be a pair."""
MAX_ANGLE = 30.0
"""Degrees at which the rays of a pair meet at most."""


def overview(cameras: Sequence[Camera]) -> list[Camera]:
    """Some of `cameras` that stand for what is to be seen from all of them."""
    return [cameras[index] for index in spread_cameras(cameras, MAX_OVERVIEW)]


def select_overview(
    cameras: Sequence[Camera], points: Float[Tensor, "n 3"], count: int
) -> list[int]:
    """Indices of up to `count` of `cameras`, ascending, that together see most of what all do.

    Args:
        cameras: Those of all photographs.
        points: On or near the surfaces of the scene, in world coordinates; at least one.
        count: How many photographs are wanted.
    """
    number = count
    while True:
        chosen = medoids(cameras, number)
        alone = [i for i in chosen if not has_partner(i, chosen, cameras, points)]
        found = sorted({*chosen, *(companion(i, cameras, points) for i in alone)})
        if len(found) <= max(count, 2):
            return found
        number -= 1


def medoids(cameras: Sequence[Camera], count: int) -> list[int]:
    """Indices, ascending, of cameras that each stand in the middle of those closest to them."""
    where = places(cameras)
    apart = torch.cdist(where, where)
    chosen = spread_cameras(cameras, count)
    for _ in range(NUM_ROUNDS):
        groups = apart[:, chosen].argmin(dim=1)
        members = [torch.nonzero(groups == group)[:, 0] for group in range(len(chosen))]
        before, chosen = chosen, [middle(apart, own) for own in members if len(own) > 0]
        if chosen == before:
            break
    return sorted(set(chosen))


def middle(apart: Float[Tensor, "n n"], members: Tensor) -> int:
    """Which of `members` lies closest to all of them, by squared distance."""
    return int(members[apart[members][:, members].square().sum(dim=1).argmin()])


def has_partner(
    index: int, chosen: Sequence[int], cameras: Sequence[Camera], points: Float[Tensor, "n 3"]
) -> bool:
    """Whether another camera of `chosen` sees enough of what a camera sees, from not too far
    aside."""
    seen = spread(sighted(cameras[index], points), MAX_POINTS)
    others = [cameras[other] for other in chosen if other != index]
    return any(shares(cameras[index], other, seen) >= MIN_SHARED for other in others)


def shares(camera: Camera, other: Camera, points: Float[Tensor, "p 3"]) -> float:
    """Share of `points`, which `camera` sees, that are in the image of the other and that their
    rays meet at, at angles that stereo can bear."""
    one, two = directions([camera, other], points)
    turn = angles(one, two)
    bearable = (turn > 0) & (turn < MAX_ANGLE)
    return (bearable & inside(*project(points, other), other)).float().mean().item()


def companion(index: int, cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> int:
    """The camera that makes the best pair with another."""
    seen = spread(sighted(cameras[index], points), MAX_POINTS)
    worth = worths(cameras[index], cameras, seen)
    pairs = pair_worths(index, worth, directions(cameras, seen)).sum(dim=-1)
    pairs[index] = -1.0
    return int(pairs.argmax())
