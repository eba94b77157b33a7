"""Selection of context views for given targets.

A photograph scores by the target's points that it shows, from similar directions; a pair also by
its triangulation angle. The score of a set is that of its best pair, summed over points. Selection
is greedy; of two further photographs that are needed to show new points, each counts half.

The score hardly tells photographs apart once one good pair shows each point, and then photographs
that stand farther off show a little more. So those that stand nearest to the targets follow the
first three, and what they leave open decides about the rest (decision 143).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.numerics.geometry import is_inside, measure_distances, project
from gscompleter.types import Camera

MAX_TARGET_POINTS = 1000
"""Points that are scored for all targets together."""
MAX_NEAR_PHOTOGRAPHS = 32
"""Photographs that score best on their own, whose pairs are scored; no others are selected."""
MIN_TARGET_POINTS = 20
"""Fewest visible points of a target; with fewer, a plane in the middle of the scene is used."""
GRID_SIDE = 8
"""Points of such a plane per image side."""
PLANES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Planes that represent an unknown scene, in normalized inverse depth from near to far."""
HALF_SCORE_ANGLE = 5.0
"""Angle between viewing directions at which the score of a photograph is halved, in degrees."""
BEST_CONTEXT_ANGLE = 0.5
"""Best triangulation angle of a pair, in degrees: some pixels of parallax."""
NARROW_FALLOFF = 0.3
"""Angle below it, in degrees, at which the score of a pair falls to a third."""
WIDE_FALLOFF = 20.0
"""Angle above it, in degrees, at which the score of a pair falls to a third."""
MIN_SHOWING_SCORE = 0.1
"""Pair score below which no pair shows a point."""
NUM_SCORED_FIRST = 3
"""Photographs that are chosen by their score before the nearest ones."""
NUM_NEAREST = 2
"""Nearest photographs that follow them."""
MIN_NEAR_WORTH = 0.25
"""Least score of a nearest photograph, relative to the best; one that looks elsewhere has less."""
OUTSIDE_SCORE = 1e-3
"""Score of a point outside of an image; it ranks photographs that show none."""


def select_context(
    targets: Sequence[Camera],
    candidates: Sequence[Camera],
    points: Float[Tensor, "n 3"],
    count: int,
) -> list[int]:
    """Select up to `count` of the candidates, and no more than `MAX_NEAR_PHOTOGRAPHS`.

    `points` are on or near surfaces, in world coordinates. There is at least one target, candidate
    and point. Returns sorted indices.
    """
    num_points = max(MAX_TARGET_POINTS // len(targets), 1)
    seen = [find_visible_points(target, points, num_points) for target in targets]
    # `worth` [c, p] is the score of each candidate at each point that some target sees.
    worth = torch.cat(
        [
            score_cameras(target, candidates, visible)
            for target, visible in zip(targets, seen, strict=True)
        ],
        dim=1,
    )

    # Pairs are scored for the best candidates alone: their number grows with the square.
    ranked = worth.sum(1).argsort(descending=True, stable=True)[:MAX_NEAR_PHOTOGRAPHS]
    paired = [candidates[i] for i in ranked.tolist()]
    rays = compute_directions(paired, torch.cat(seen))
    chosen = select_greedily(worth[ranked], rays, measure_distances(paired, targets), count)
    return sorted(ranked[chosen].tolist())


def select_greedily(
    worth: Float[Tensor, "c p"],
    rays: Float[Tensor, "c p 3"],
    distances: Float[Tensor, "c"],
    count: int,
) -> list[int]:
    """Choose the best pair, then repeatedly the candidate that improves the pair scores most.

    The nearest candidates that show enough follow the first `NUM_SCORED_FIRST`. Candidates come in
    descending order of their summed `worth`; `distances` are those to the targets, in scene units.
    """
    count = min(count, len(worth))
    # One alone forms no pair: the first candidate is the best on its own.
    if count < 2:
        return list(range(count))

    # `pairs` [c, c, p] are the scores of all pairs at each point. A point counts by the best pair
    # of chosen candidates, `best` [p].
    pairs = torch.stack([score_pairs(i, worth, rays) for i in range(len(worth))])
    totals = pairs.sum(-1)
    # A candidate is no pair with itself, also where all stand in one place and no pair scores.
    totals.fill_diagonal_(-1.0)
    first, second = divmod(int(totals.argmax()), len(worth))
    chosen = [first, second]
    best = pairs[first, second]
    shows_enough = worth.sum(-1) >= MIN_NEAR_WORTH * worth.sum(-1).amax()
    while len(chosen) < count:
        # The gain of each candidate together with one of the chosen.
        now = (pairs[chosen].amax(0) - best).clamp_min(0).sum(-1)
        # Points that no pair shows may need two further photographs. Each counts half of what they
        # gain together, since the first alone gains nothing.
        later = (pairs.amax(0) * (best < MIN_SHOWING_SCORE)).sum(-1) / 2
        # The last term breaks ties by what a photograph shows on its own.
        gains = torch.maximum(now, later) + OUTSIDE_SCORE * worth.sum(-1)
        gains[chosen] = -1.0
        near = shows_enough.clone()
        near[chosen] = False
        if NUM_SCORED_FIRST <= len(chosen) < NUM_SCORED_FIRST + NUM_NEAREST and near.any():
            added = int(distances.where(near, math.inf).argmin())
        else:
            added = int(gains.argmax())
        best = torch.maximum(best, pairs[chosen, added].amax(0))
        chosen.append(added)
    return chosen


def score_pairs(
    one: int, worth: Float[Tensor, "c p"], rays: Float[Tensor, "c p 3"]
) -> Float[Tensor, "c p"]:
    """Score the pairs of candidate `one` with all others at each point."""
    # Below the best angle, depth is uncertain, and the score falls fast; above, images get less
    # alike, and it falls slowly.
    excess = compute_angles(rays[one], rays) - BEST_CONTEXT_ANGLE
    width = torch.where(excess < 0, NARROW_FALLOFF, WIDE_FALLOFF)
    together = torch.minimum(worth[one], worth) * torch.exp(-((excess / width) ** 2))
    same_place = (rays[one] == rays).all(-1)
    return together.masked_fill(same_place, 0.0)


def score_cameras(
    target: Camera, candidates: Sequence[Camera], points: Float[Tensor, "p 3"]
) -> Float[Tensor, "c p"]:
    """Score each candidate at points that the target sees."""
    own = compute_directions([target], points)[0]
    angles = compute_angles(own, compute_directions(candidates, points))
    shown = torch.stack([is_inside(*project(points, camera), camera) for camera in candidates])
    return torch.where(shown, 1.0, OUTSIDE_SCORE) / (1 + (angles / HALF_SCORE_ANGLE) ** 2)


def find_visible_points(
    target: Camera, points: Float[Tensor, "n 3"], count: int = MAX_TARGET_POINTS
) -> Float[Tensor, "p 3"]:
    """Return every n-th point that a target sees, or points on a plane if there are few."""
    seen = points[is_inside(*project(points, target), target)]
    if len(seen) < MIN_TARGET_POINTS:
        seen = make_plane_in_front(target, (points - target.center).norm(dim=-1).median().item())
    step = math.ceil(len(seen) / count)
    return seen[::step]


def make_points_in_front(target: Camera, near: float, far: float) -> Float[Tensor, "p 3"]:
    """Make points on planes in front of a target, between two z-depths in scene units."""
    inverse = [(1 - share) / near + share / far for share in PLANES]
    return torch.cat([make_plane_in_front(target, 1 / value) for value in inverse])


def make_plane_in_front(target: Camera, depth: float) -> Float[Tensor, "p 3"]:
    """Make a grid of points at one z-depth, in scene units, over the image of a target."""
    rays = target.z_rays()
    rows = torch.linspace(0, target.height - 1, GRID_SIDE).round().long()
    columns = torch.linspace(0, target.width - 1, GRID_SIDE).round().long()
    return target.center + depth * rays[rows][:, columns].reshape(-1, 3)


def compute_directions(
    cameras: Sequence[Camera], points: Float[Tensor, "p 3"]
) -> Float[Tensor, "c p 3"]:
    """Compute unit vectors from each camera centre to each point."""
    centers = torch.stack([camera.center for camera in cameras])
    return torch.nn.functional.normalize((points - centers[:, None]).double(), dim=-1)


def compute_angles(
    a: Float[Tensor, "*#shape 3"], b: Float[Tensor, "*#shape 3"]
) -> Float[Tensor, "*shape"]:
    """Compute the angle between unit vectors in degrees, exact for small angles."""
    # From half the chord: the arc cosine of the scalar product is inexact near 0.
    return torch.rad2deg(2 * torch.asin(((a - b).norm(dim=-1) / 2).clamp_max(1.0)))
