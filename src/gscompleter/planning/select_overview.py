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
    BEST_CONTEXT_ANGLE,
    NARROW_FALLOFF,
    compute_angles,
    compute_directions,
    find_visible_points,
    score_cameras,
    score_pairs,
)
from gscompleter.types import Camera

MAX_OVERVIEW = 16
"""Most cameras that represent all others."""
MAX_MEDOID_ROUNDS = 20
"""Most iterations of k-medoids."""
MIN_SHARED_FRACTION = 0.3
"""Smallest fraction of visible points that the other camera of a pair must see, too."""
MIN_ANGLE = BEST_CONTEXT_ANGLE - NARROW_FALLOFF
MAX_ANGLE = 30.0
"""Smallest and largest triangulation angle of a pair, in degrees. At the smallest, `select_context`
scores a pair by a third of the best."""


def summarize_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """Select cameras that represent all others."""
    return [cameras[index] for index in select_spread_cameras(cameras, MAX_OVERVIEW)]


def select_overview(
    cameras: Sequence[Camera], points: Float[Tensor, "n 3"], count: int
) -> list[int]:
    """Select up to `count` cameras, but at least two, that together see most of the scene.

    `points` are on or near surfaces, in world coordinates; at least one. Returns sorted indices.
    """
    # Partners take places of medoids, so there are fewer medoids until both are at most `count`.
    # Two are needed in any case: one medoid and its partner.
    num_medoids = count
    while True:
        medoids = find_medoids(cameras, num_medoids)
        alone = [i for i in medoids if not has_partner(i, medoids, cameras, points)]
        partners = [find_partner(i, cameras, points) for i in alone]
        chosen = sorted({*medoids, *partners})
        if len(chosen) <= max(count, 2):
            return chosen
        num_medoids -= 1


def find_medoids(cameras: Sequence[Camera], count: int) -> list[int]:
    """Cluster cameras by k-medoids; return the sorted indices of the medoids."""
    places = embed_cameras(cameras)
    distances = torch.cdist(places, places)
    medoids = select_spread_cameras(cameras, count)
    for _ in range(MAX_MEDOID_ROUNDS):
        # Each camera joins the nearest medoid; of each group, the camera with the smallest squared
        # distances to the others is the next one.
        nearest = distances[:, medoids].argmin(dim=1)
        medoids_before = medoids
        medoids = []
        for group in nearest.unique():
            members = torch.nonzero(nearest == group)[:, 0]
            costs = distances[members][:, members].square().sum(dim=1)
            medoids.append(int(members[costs.argmin()]))
        if medoids == medoids_before:
            break
    return sorted(set(medoids))


def has_partner(
    index: int, chosen: Sequence[int], cameras: Sequence[Camera], points: Float[Tensor, "n 3"]
) -> bool:
    """Return True if another chosen camera shares enough points at usable triangulation angles."""
    visible = find_visible_points(cameras[index], points)
    own, *others = compute_directions([cameras[i] for i in (index, *chosen)], visible)
    for other, directions in zip(chosen, others, strict=True):
        camera = cameras[other]
        angles = compute_angles(own, directions)
        shared = (angles > MIN_ANGLE) & (angles < MAX_ANGLE)
        shared &= is_inside(*project(visible, camera), camera)
        if other != index and shared.float().mean().item() >= MIN_SHARED_FRACTION:
            return True
    return False


def find_partner(index: int, cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> int:
    """Find the camera that makes the best stereo pair with another."""
    visible = find_visible_points(cameras[index], points)
    worth = score_cameras(cameras[index], cameras, visible)
    pairs = score_pairs(index, worth, compute_directions(cameras, visible)).sum(dim=-1)
    pairs[index] = -1.0  # a camera is no partner of itself
    return int(pairs.argmax())
