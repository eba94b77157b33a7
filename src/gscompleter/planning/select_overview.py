"""Selection of context views for no target: an overview of the scene.

The cameras are clustered by k-medoids. One whose pairs show too little in stereo gets the camera
beside it that makes the best pair.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.numerics.geometry import embed_cameras, is_inside, project, select_spread_cameras
from gscompleter.planning.select_context import (
    compute_angles,
    compute_directions,
    find_visible_points,
    score_cameras,
    score_pairs,
)
from gscompleter.types import Camera

MAX_OVERVIEW = 16
"""Most cameras that represent all others."""
NUM_ROUNDS = 20
"""Most iterations of k-medoids."""
MIN_SHARED_FRACTION = 0.3
"""Smallest fraction of visible points that the other camera of a pair must see, too."""
MAX_ANGLE = 30.0
"""Largest triangulation angle of a pair, in degrees."""


def summarize_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """Select cameras that represent all others."""
    return [cameras[index] for index in select_spread_cameras(cameras, MAX_OVERVIEW)]


def select_overview(
    cameras: Sequence[Camera], points: Float[Tensor, "n 3"], count: int
) -> list[int]:
    """Select up to `count` cameras that together see most of the scene; return sorted indices.

    `points` are on or near surfaces, in world coordinates; at least one.
    """
    number = count
    while True:
        chosen = find_medoids(cameras, number)
        alone = [i for i in chosen if not has_partner(i, chosen, cameras, points)]
        found = sorted({*chosen, *(find_partner(i, cameras, points) for i in alone)})
        if len(found) <= max(count, 2):
            return found
        number -= 1


def find_medoids(cameras: Sequence[Camera], count: int) -> list[int]:
    """Cluster cameras by k-medoids; return the sorted indices of the medoids."""
    where = embed_cameras(cameras)
    apart = torch.cdist(where, where)
    chosen = select_spread_cameras(cameras, count)
    for _ in range(NUM_ROUNDS):
        groups = apart[:, chosen].argmin(dim=1)
        members = [torch.nonzero(groups == group)[:, 0] for group in groups.unique()]
        costs = [apart[own][:, own].square().sum(dim=1) for own in members]
        pairs = zip(members, costs, strict=True)
        before, chosen = chosen, [int(own[cost.argmin()]) for own, cost in pairs]
        if chosen == before:
            break
    return sorted(set(chosen))


def has_partner(
    index: int, chosen: Sequence[int], cameras: Sequence[Camera], points: Float[Tensor, "n 3"]
) -> bool:
    """Return True if another chosen camera shares enough points at usable triangulation angles."""
    seen = find_visible_points(cameras[index], points)
    own, *rays = compute_directions([cameras[i] for i in (index, *chosen)], seen)
    for number, directions in zip(chosen, rays, strict=True):
        turn, camera = compute_angles(own, directions), cameras[number]
        shared = (turn > 0) & (turn < MAX_ANGLE) & is_inside(*project(seen, camera), camera)
        if number != index and shared.float().mean().item() >= MIN_SHARED_FRACTION:
            return True
    return False


def find_partner(index: int, cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> int:
    """Find the camera that makes the best stereo pair with another."""
    seen = find_visible_points(cameras[index], points)
    worth = score_cameras(cameras[index], cameras, seen)
    pairs = score_pairs(index, worth, compute_directions(cameras, seen)).sum(dim=-1)
    pairs[index] = -1.0
    return int(pairs.argmax())
