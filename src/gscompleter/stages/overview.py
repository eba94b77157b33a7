"""Selection of context views without a target: spread over the scene, and in stereo pairs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import is_inside, project
from gscompleter.stages.candidates import embed_cameras, select_spread_cameras
from gscompleter.stages.selection import (
    MAX_POINTS,
    compute_angles,
    compute_directions,
    find_visible_points,
    score_cameras,
    score_pairs,
    subsample,
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
        members = [torch.nonzero(groups == group)[:, 0] for group in range(len(chosen))]
        before, chosen = chosen, [find_medoid(apart, own) for own in members if len(own) > 0]
        if chosen == before:
            break
    return sorted(set(chosen))


def find_medoid(apart: Float[Tensor, "n n"], members: Tensor) -> int:
    """Find the member with the smallest sum of squared distances to the others."""
    return int(members[apart[members][:, members].square().sum(dim=1).argmin()])


def has_partner(
    index: int, chosen: Sequence[int], cameras: Sequence[Camera], points: Float[Tensor, "n 3"]
) -> bool:
    """Return True if another chosen camera shares enough points at usable angles."""
    seen = subsample(find_visible_points(cameras[index], points), MAX_POINTS)
    others = [cameras[other] for other in chosen if other != index]
    return any(
        compute_shared_fraction(cameras[index], other, seen) >= MIN_SHARED_FRACTION
        for other in others
    )


def compute_shared_fraction(camera: Camera, other: Camera, points: Float[Tensor, "p 3"]) -> float:
    """Compute the fraction of points that another camera sees at a usable triangulation angle."""
    one, two = compute_directions([camera, other], points)
    turn = compute_angles(one, two)
    bearable = (turn > 0) & (turn < MAX_ANGLE)
    return (bearable & is_inside(*project(points, other), other)).float().mean().item()


def find_partner(index: int, cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> int:
    """Find the camera that makes the best stereo pair with another."""
    seen = subsample(find_visible_points(cameras[index], points), MAX_POINTS)
    worth = score_cameras(cameras[index], cameras, seen)
    pairs = score_pairs(index, worth, compute_directions(cameras, seen)).sum(dim=-1)
    pairs[index] = -1.0
    return int(pairs.argmax())
