"""Search of the similarity that brings surfaces from elsewhere to where a scene shows them.

A scan has an origin, axes and a unit of its own, and shows other parts than the scene does. Two
points on a surface and their normals determine a similarity, and the angles between both normals
and the line through the points are the same in every frame: pairs of equal angles propose
similarities. Those by which most of what is seen lies on the surface are refined.

"Seen" is what photographs see of the scene, in its frame; "surface" is the geometry from elsewhere,
in its own. Similarities are 4x4 matrices in float64, from the surface to the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from gscompleter.numerics.given_geometry import GivenGeometry, fit_planes, move_points
from gscompleter.numerics.kernels import surface_agreement as kernels

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Modules of scipy are imported in functions, since nothing else of a completion needs them, and
# they take long.

NUM_SURFACE_POINTS = 20_000
"""Points that stand for a surface."""
MAX_FACES = 200_000
"""Most triangles on which they are chosen."""
NUM_NORMAL_POINTS = 9
"""Points, a seen one and its neighbours, whose plane tells its normal."""
MIN_SEEN = 100
"""Fewest seen points by which a surface is aligned."""

# How similarities are proposed.
NUM_PAIRED_POINTS = 300
"""Points of the surface whose pairs are tried: of a room of 6 m, one every 0.7 m."""
NUM_PAIRS = 80
"""Seen pairs that are looked up among them."""
MAX_COSINE_DISTANCE = 0.15
"""Largest distance between the three cosines of two pairs whose angles count as equal: normals of
noisy depth err by degrees."""
MAX_EQUAL_PAIRS = 2000
"""Most pairs of the surface that are tried for a seen one, chosen at random."""
SEEN_SIZES = (0.1, 2.0)
"""Smallest and largest size of what is seen, relative to that of the surface."""
NUM_SCORED = 128
"""Seen points by which each proposal is scored."""
NUM_BEST_PROPOSALS = 5
"""Proposals of each pair that are scored by all seen points."""
NUM_REFINED_PROPOSALS = 16
"""Proposals that are refined."""
NUM_CELLS = 96
"""Cells along the longest side of the grid that tells how far the surface is."""
REACH = 0.08
"""Largest distance of a seen point from the surface it lies on, relative to its depth: proposals
err by several percent."""
MIN_PARALLEL = 0.8
"""Smallest cosine between the normal of a seen point and that of the surface it lies on."""
SAME_START = 0.1
"""Largest move from one proposal to another that is no start of its own, relative to the size of
what is seen."""
SAME_PLACE = 0.025
"""The same for refined similarities."""
NUM_PLACES = 6
"""Most refined similarities that are worth a comparison."""
MAX_SAME = 0.1
"""Largest distance of a surface in two places that count as one, relative to the size of what is
seen."""
MAX_ELSEWHERE = 0.05
"""Largest share of a surface that is farther away in two places that count as one."""

# How they are refined.
GATES = (*np.geomspace(0.3, 0.05, 12), *[0.05] * 12)
"""Largest distance of closest points in each iteration, relative to the depth."""
MIN_SPREAD = 0.1
"""Smallest gap from which points count less, relative to the gate."""
DAMPING = 1e-4
"""Damping relative to the best determined direction, so that no other one runs away."""


SurfaceSimilarity = Float[ndarray, "4 4"]


@dataclass(frozen=True)
class SurfacePoints:
    """Points on surfaces, with unit normals whose sign means nothing."""

    points: Float[ndarray, "n 3"]
    normals: Float[ndarray, "n 3"]

    def with_both_signs(self) -> SurfacePoints:
        """Return all points again, with the opposite normals."""
        return SurfacePoints(
            np.concatenate([self.points, self.points]),
            np.concatenate([self.normals, -self.normals]),
        )

    @cached_property
    def tree(self) -> cKDTree:
        """Find closest points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


@dataclass(frozen=True)
class SeenPoints(SurfacePoints):
    """What photographs see, with the z-depth of each point at its camera."""

    depths: Float[ndarray, "n"]

    @cached_property
    def middle(self) -> Float[ndarray, "3"]:
        """Find the middle of most points."""
        return np.median(self.points, axis=0)

    @cached_property
    def size(self) -> float:
        """Measure the distance of most points from their middle."""
        return measure_spread_of_points(self.points)

    def choose(self, rows: Int[ndarray, "k"]) -> SeenPoints:
        """Return some of the points."""
        return SeenPoints(self.points[rows], self.normals[rows], self.depths[rows])


def measure_spread_of_points(points: Float[ndarray, "n 3"]) -> float:
    """Measure the distance of most points from their middle, which stray points do not change."""
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.quantile(distances, 0.9))


def make_seen_points(points: Float[ndarray, "n 3"], depths: Float[ndarray, "n"]) -> SeenPoints:
    """Make seen points, with the normals of their neighbours' planes; none of too few."""
    from scipy.spatial import cKDTree

    if len(points) < MIN_SEEN:
        points, depths = points[:0], depths[:0]
    neighbours = cKDTree(points).query(points, NUM_NORMAL_POINTS)[1]
    return SeenPoints(points, fit_planes(points, neighbours)[:, :, 0], depths)


def sample_surface(geometry: GivenGeometry, rng: np.random.Generator) -> SurfacePoints:
    """Choose points of a geometry at random, equally many in equal areas.

    Returns none of a geometry without an area.
    """
    faces = geometry.faces
    if len(faces) > MAX_FACES:
        faces = faces[rng.choice(len(faces), MAX_FACES, replace=False)]
    a, b, c = geometry.vertices[faces].transpose(1, 0, 2)
    crossed = np.cross(b - a, c - a)
    areas = np.linalg.norm(crossed, axis=1)
    if areas.sum() == 0:
        return SurfacePoints(np.empty((0, 3)), np.empty((0, 3)))
    rows = rng.choice(len(areas), NUM_SURFACE_POINTS, p=areas / areas.sum())
    # Uniform in the parallelogram of two sides, whose other half is turned back.
    along, across = rng.random((2, NUM_SURFACE_POINTS, 1))
    is_beyond = along + across > 1
    along, across = (np.where(is_beyond, 1 - part, part) for part in (along, across))
    points = a[rows] + along * (b - a)[rows] + across * (c - a)[rows]
    return SurfacePoints(points, crossed[rows] / areas[rows, None])


def align_surface(
    surface: SurfacePoints, seen: SeenPoints, rng: np.random.Generator
) -> list[SurfaceSimilarity]:
    """Find similarities by which much of what is seen lies on a surface, the best first.

    Several are found if the surface is symmetric, or what is seen tells too little.
    """
    if len(surface.points) == 0 or len(seen.points) < MIN_SEEN:
        return []
    starts = propose_similarities(surface, seen, rng)
    refined = [fit_closest_points(start, surface, seen) for start in starts]
    refined.sort(key=lambda fit: -fit[1])
    return keep_distinct([place for place, _ in refined], seen, SAME_PLACE, NUM_PLACES)


def propose_similarities(
    surface: SurfacePoints, seen: SeenPoints, rng: np.random.Generator
) -> list[SurfaceSimilarity]:
    """Propose similarities by pairs of points with equal angles, the best first."""
    from scipy.spatial import cKDTree

    field = DistanceField.make(surface)
    sizes = measure_spread_of_points(surface.points) * np.array(SEEN_SIZES)
    paired = SurfacePoints(surface.points[:NUM_PAIRED_POINTS], surface.normals[:NUM_PAIRED_POINTS])
    pairs = PointPairs.make(paired.with_both_signs(), *list_pairs(NUM_PAIRED_POINTS))
    tree = cKDTree(pairs.cosines)
    scored = seen.choose(rng.choice(len(seen.points), min(NUM_SCORED, len(seen.points)), False))
    seen_pairs = choose_far_pairs(seen, rng)

    proposals = []
    for number, cosines in enumerate(seen_pairs.cosines):
        equal = np.array(tree.query_ball_point(cosines, MAX_COSINE_DISTANCE), int)
        if len(equal) > MAX_EQUAL_PAIRS:
            equal = rng.choice(equal, MAX_EQUAL_PAIRS, replace=False)
        scales = seen_pairs.lengths[number] / pairs.lengths[equal]
        # The size of what is seen in the unit of the surface.
        is_sized = (seen.size / scales > sizes[0]) & (seen.size / scales < sizes[1])
        proposed = match_pairs(pairs, equal[is_sized], seen_pairs, number)
        order = np.argsort(-field.measure_agreement(proposed, scored), kind="stable")
        proposals.append(proposed[order[:NUM_BEST_PROPOSALS]])
    kept = np.concatenate(proposals) if proposals else np.empty((0, 4, 4))
    order = np.argsort(-field.measure_agreement(kept, seen), kind="stable")
    return keep_distinct(list(kept[order]), seen, SAME_START, NUM_REFINED_PROPOSALS)


def match_pairs(
    pairs: PointPairs, rows: Int[ndarray, "k"], seen_pairs: PointPairs, number: int
) -> Float[ndarray, "k 4 4"]:
    """Compute the similarities that bring pairs of the surface, by their rows, to one seen pair."""
    scales = seen_pairs.lengths[number] / pairs.lengths[rows]
    # From the frame of the surface's pair to that of the seen one.
    turns = seen_pairs.frames[number] @ pairs.frames[rows].transpose(0, 2, 1)
    similarities = np.tile(np.eye(4), (len(rows), 1, 1))
    similarities[:, :3, :3] = scales[:, None, None] * turns
    moved = np.einsum("nij,nj->ni", similarities[:, :3, :3], pairs.middles[rows])
    similarities[:, :3, 3] = seen_pairs.middles[number] - moved
    return similarities


def list_pairs(count: int) -> tuple[Int[ndarray, "m"], Int[ndarray, "m"]]:
    """List ordered pairs of different points, each of which has normals of both signs.

    Rows from `count` on are those of the negative normals.
    """
    first, second = np.divmod(np.arange(4 * count * count), 2 * count)
    is_pair = first % count != second % count
    return first[is_pair], second[is_pair]


def choose_far_pairs(seen: SeenPoints, rng: np.random.Generator) -> PointPairs:
    """Choose pairs of seen points that lie far apart: these determine a similarity best."""
    first, second = rng.integers(len(seen.points), size=(2, 20 * NUM_PAIRS))
    is_far = np.linalg.norm(seen.points[second] - seen.points[first], axis=1) > seen.size
    pairs = PointPairs.make(seen, first[is_far], second[is_far])
    # A normal along the line through both points does not tell the turn about it.
    return pairs.choose(np.flatnonzero(np.abs(pairs.cosines[:, 0]) < 0.9)[:NUM_PAIRS])


@dataclass(frozen=True)
class PointPairs:
    """Pairs of points with normals, and the frames that they span."""

    lengths: Float[ndarray, "m"]
    middles: Float[ndarray, "m 3"]
    cosines: Float[ndarray, "m 3"]
    """From the line through both points to each normal, and from one normal to the other."""
    frames: Float[ndarray, "m 3 3"]
    """Rotations whose columns are the line, the first normal as far as it is across, and the
    direction across both."""

    @classmethod
    def make(
        cls, points: SurfacePoints, first: Int[ndarray, "m"], second: Int[ndarray, "m"]
    ) -> PointPairs:
        """Make pairs of points by their rows."""
        normal, other = points.normals[first], points.normals[second]
        line = points.points[second] - points.points[first]
        lengths = np.maximum(np.linalg.norm(line, axis=1), 1e-300)
        line = line / lengths[:, None]
        angles = ((line, normal), (line, other), (normal, other))
        cosines = np.stack([np.einsum("ni,ni->n", *sides) for sides in angles], axis=1)
        across = normal - cosines[:, :1] * line
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        frames = np.stack([line, across, np.cross(line, across)], axis=2)
        middles = (points.points[first] + points.points[second]) / 2
        return cls(lengths, middles, cosines, frames)

    def choose(self, rows: Int[ndarray, "k"]) -> PointPairs:
        """Return some of the pairs."""
        parts = (self.lengths, self.middles, self.cosines, self.frames)
        return PointPairs(*(part[rows] for part in parts))


@dataclass(frozen=True)
class DistanceField:
    """Distances from a surface, and its normals, in the cells of a grid around it."""

    low: Float[ndarray, "3"]
    cell: float
    """Side of a cell, in the unit of the surface."""
    distances: Float[ndarray, "x y z"]
    """To the closest point of the surface, in cells."""
    normals: Float[ndarray, "x y z 3"]
    """Of that point."""

    @classmethod
    def make(cls, surface: SurfacePoints) -> DistanceField:
        """Make the grid around nearly all points of a surface."""
        from scipy.ndimage import distance_transform_edt

        low, high = np.quantile(surface.points, (0.002, 0.998), axis=0)
        cell = float((high - low).max()) / NUM_CELLS
        shape = np.floor((high - low) / cell).astype(int) + 1
        cells = np.floor((surface.points - low) / cell).astype(int)
        is_inside = ((cells >= 0) & (cells < shape)).all(axis=1)
        x, y, z = cells[is_inside].T
        is_free = np.ones(shape, bool)
        is_free[x, y, z] = False
        normals = np.zeros((*shape, 3))
        normals[x, y, z] = surface.normals[is_inside]
        distances, closest = distance_transform_edt(is_free, return_indices=True)
        return cls(low, cell, distances, normals[tuple(closest)])

    def measure_agreement(
        self, similarities: Float[ndarray, "m 4 4"], seen: SeenPoints
    ) -> Float[ndarray, "m"]:
        """Measure the share of seen points that lie on the surface, by each similarity.

        A point beside the grid is as far as the nearest cell, and as the way from there.
        """
        # From the scene to cells.
        linear = np.linalg.inv(similarities[:, :3, :3])
        shift = np.einsum("mij,mj->mi", linear, similarities[:, :3, 3])
        return kernels.measure_shares_on_surface(
            linear / self.cell,
            -(shift + self.low) / self.cell,
            seen.points,
            seen.normals,
            REACH * seen.depths,
            self.distances,
            self.normals,
            MIN_PARALLEL,
        )


def keep_distinct(
    similarities: Sequence[SurfaceSimilarity], seen: SeenPoints, same: float, most: int
) -> list[SurfaceSimilarity]:
    """Keep the first of all similarities that bring a surface to about one place, of `most` places.

    `same` is the largest move between these, relative to the size of what is seen.
    """
    ends = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    marks = seen.middle + seen.size * ends
    kept: list[SurfaceSimilarity] = []
    for similarity in similarities:
        back = move_points(np.linalg.inv(similarity), marks)
        moves = (move_points(other, back) - marks for other in kept)
        if all(np.linalg.norm(move, axis=1).max() > same * seen.size for move in moves):
            kept.append(similarity)
        if len(kept) == most:
            break
    return kept


def are_same_place(
    first: SurfaceSimilarity, second: SurfaceSimilarity, surface: SurfacePoints, seen: SeenPoints
) -> bool:
    """Return True if two similarities bring nearly all of a surface to the same place.

    As those of a symmetric surface do.
    """
    # Where the second brings the surface, seen from the frame of the surface that the first brings
    # there. Distances along the normals do not depend on how dense its points are.
    points = move_points(np.linalg.inv(first) @ second, surface.points)
    closest = surface.tree.query(points)[1]
    gaps = np.einsum("ni,ni->n", points - surface.points[closest], surface.normals[closest])
    limit = MAX_SAME * seen.size / get_similarity_scale(first)
    return float((np.abs(gaps) > limit).mean()) <= MAX_ELSEWHERE


def fit_closest_points(
    similarity: SurfaceSimilarity, surface: SurfacePoints, seen: SeenPoints
) -> tuple[SurfaceSimilarity, float]:
    """Refine a similarity by iterated closest points.

    Distances count along the normals of the surface, relative to the depth of each seen point. Also
    returns the share of seen points on the surface.
    """
    if len(surface.points) == 0 or len(seen.points) == 0:
        return similarity, 0.0
    for gate in GATES:
        equations = make_gap_equations(similarity, surface, seen, gate)
        if len(equations.gaps) < MIN_SEEN:
            break
        similarity = make_move(equations.solve(), seen) @ similarity
    distances = find_closest(similarity, surface, seen)[1]
    return similarity, float((distances <= GATES[-1]).mean())


@dataclass(frozen=True)
class GapEquations:
    """How moves change the gaps from a surface to seen points, as a weighted linear system.

    The unknowns are a turn, a shift and a growth about the middle of what is seen, whose size is
    the unit of lengths.
    """

    rows: Float[ndarray, "n 7"]
    """Change of each gap by the unknowns: a turn about x, y and z, a shift along them, a growth."""
    gaps: Float[ndarray, "n"]
    """Along the normals of the surface, relative to the depth of each seen point."""
    weights: Float[ndarray, "n"]

    def decompose(self) -> tuple[Float[ndarray, "7"], Float[ndarray, "7 7"]]:
        """Find seven moves, and by which sum of squares each changes the gaps.

        Returns the sums, the smallest first, and the moves, as columns in the same order.
        """
        sums, moves = np.linalg.eigh(self.rows.T @ (self.weights[:, None] * self.rows))
        return sums, moves

    def solve(self) -> Float[ndarray, "7"]:
        """Find the move that closes the gaps."""
        sums, moves = self.decompose()
        wanted = self.rows.T @ (self.weights * self.gaps)
        return moves @ (moves.T @ wanted / (sums + DAMPING * sums[-1]))


def make_gap_equations(
    similarity: SurfaceSimilarity, surface: SurfacePoints, seen: SeenPoints, gate: float
) -> GapEquations:
    """Make the equations of the seen points whose distance over the depth is at most `gate`."""
    closest, distances = find_closest(similarity, surface, seen)
    near = np.flatnonzero(distances <= gate)
    points = move_points(similarity, surface.points[closest[near]])
    normals = surface.normals[closest[near]] @ np.linalg.inv(similarity[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    arms = (points - seen.middle) / seen.size
    growth = np.einsum("ni,ni->n", arms, normals)
    scale = seen.size / seen.depths[near]
    rows = scale[:, None] * np.column_stack([np.cross(arms, normals), normals, growth])
    gaps = scale * np.einsum("ni,ni->n", (seen.points[near] - points) / seen.size, normals)
    # Depth errs to one side at the edges of surfaces, so that large gaps count for nothing
    # (Geman and McClure's loss); at first all do, or the nearest wall would hold the rest.
    spread = max(2 * float(np.median(np.abs(gaps))), MIN_SPREAD * gate) if len(gaps) else 1.0
    return GapEquations(rows, gaps, 1 / (1 + (gaps / spread) ** 2) ** 2)


def find_least_determined_move(
    similarity: SurfaceSimilarity, surface: SurfacePoints, seen: SeenPoints
) -> Float[ndarray, "7"]:
    """Find the move, of length 1, that changes the gaps from a surface to seen points least.

    Along one plane it changes none.
    """
    return make_gap_equations(similarity, surface, seen, GATES[-1]).decompose()[1][:, 0]


def move_least_determined(
    similarity: SurfaceSimilarity, surface: SurfacePoints, seen: SeenPoints, length: float
) -> tuple[SurfaceSimilarity, SurfaceSimilarity]:
    """Move a surface both ways by the move that is least determined.

    `length` is that of the move, relative to the size of what is seen.
    """
    move = length * find_least_determined_move(similarity, surface, seen)
    return make_move(move, seen) @ similarity, make_move(-move, seen) @ similarity


def find_closest(
    similarity: SurfaceSimilarity, surface: SurfacePoints, seen: SeenPoints
) -> tuple[Int[ndarray, "n"], Float[ndarray, "n"]]:
    """Find the closest point of a surface to each seen one, and its distance over the depth."""
    distances, closest = surface.tree.query(move_points(np.linalg.inv(similarity), seen.points))
    return closest, get_similarity_scale(similarity) * distances / seen.depths


def get_similarity_scale(similarity: SurfaceSimilarity) -> float:
    """Get the factor of lengths."""
    return float(np.cbrt(np.linalg.det(similarity[:3, :3])))


def make_move(move: Float[ndarray, "7"], seen: SeenPoints) -> SurfaceSimilarity:
    """Make the similarity of a turn, a shift and a growth about the middle of what is seen.

    All three go on together as they begin (the exponential map), so that a long move along a plane,
    an edge or a cylinder stays on it.
    """
    from scipy.linalg import expm

    x, y, z = move[:3]
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[move[6], -z, y], [z, move[6], -x], [-y, x, move[6]]]
    generator[:3, 3] = seen.size * move[3:6] - generator[:3, :3] @ seen.middle
    return expm(generator)
