"""Selection of the photographs that each photograph is matched with.

Pairs are scored by shared features and triangulation angle (Schönberger et al., ECCV 2016). Only
photographs with a similar position and direction are compared, for linear time.

The best two often leave a part of a photograph out, such as a door post at its side that only the
next frame shows as well. So one more photograph is taken, the one that shows most of that part.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.numerics.two_views import find_near_pairs
from gscompleter.reconstructors.features.matches import (
    Pixels,
    detect_features,
    find_fitting_matches,
    match_features,
    triangulate_valid,
)
from gscompleter.reconstructors.features.stereo_image import StereoImage

NUM_SOURCES = 2
"""Number of best neighbours per photograph."""
COVERAGE_CELLS = 16
"""Rows and columns of the grid in which matches count as covering a photograph."""
MIN_ADDED_CELLS = 0.05
"""Share of all covered cells that a neighbour has to add to be taken; 0.15 loses 0.3 dB."""
MIN_COVERING_MATCHES = 20
"""Fewest matches that fit the poses, of a neighbour that is taken for what it covers."""
NUM_COMPARED = 6
"""Number of photographs per photograph whose features are compared."""
BEST_STEREO_ANGLE = 5.0
"""Best triangulation angle, in degrees."""
NARROWER_SIGMA = 2.0
"""Standard deviation of the score below that angle, in degrees."""
WIDER_SIGMA = 10.0
"""Standard deviation of the score above that angle, in degrees."""
UNMATCHED_SCORE = 1e-6
"""Score of a pair without shared features: better than no neighbour."""

Pair = tuple[int, int]
Matches = dict[Pair, tuple[Pixels, Pixels]]
"""Pixels of the same features in photographs i < j."""


@dataclass(frozen=True)
class Neighbours:
    """Selected neighbours of all photographs."""

    neighbours_of: tuple[tuple[int, ...], ...]
    """Neighbours of each photograph, the best one first, and last the one that covers the rest."""
    matches: Matches

    @property
    def pairs(self) -> list[Pair]:
        """Pairs i < j of neighbours."""
        return sort_pairs((i, j) for i, others in enumerate(self.neighbours_of) for j in others)

    def find_partners(self, number: int) -> list[int]:
        """List the neighbours of a photograph and those it is a neighbour of."""
        back = {other for other, chosen in enumerate(self.neighbours_of) if number in chosen}
        return sorted(back | set(self.neighbours_of[number]))


def find_neighbours(images: Sequence[StereoImage], count: int = NUM_SOURCES) -> Neighbours:
    """Select up to `count` best neighbours for each image, and one that covers the rest."""
    pairs = find_close_pairs(images)
    features = map_in_parallel(detect_features, images)
    matched = map_in_parallel(
        match_features, [features[i] for i, _ in pairs], [features[j] for _, j in pairs]
    )
    matches = dict(zip(pairs, matched, strict=True))
    # 0 for pairs that were not compared, which become no neighbours.
    scores = np.zeros((len(images), len(images)))
    for (i, j), (in_i, in_j) in matches.items():
        score = UNMATCHED_SCORE + score_pair(images[i], images[j], in_i, in_j)
        scores[i, j] = score
        scores[j, i] = score
    # A stable order: of equal scores the first image wins on every machine.
    ranked = (-scores).argsort(axis=1, kind="stable")[:, :count]
    chosen = []
    for i, row in enumerate(ranked):
        best = [int(j) for j in row if scores[i, j] > 0]
        chosen.append((*best, *find_covering(i, images, best, matches)))
    return Neighbours(tuple(chosen), matches)


def find_covering(
    number: int, images: Sequence[StereoImage], chosen: Sequence[int], matches: Matches
) -> list[int]:
    """Find the photograph whose matches cover most of what those chosen leave out, if any.

    Only matches that fit the poses count: photographs without a common surface have false ones.
    """
    covered: dict[int, Bool[np.ndarray, "cells cells"]] = {}
    for (i, j), (in_i, in_j) in sorted(matches.items()):
        if number in (i, j):
            other, pixels = (j, in_i) if number == i else (i, in_j)
            is_true = find_fitting_matches(images[i], images[j], in_i, in_j)
            covered[other] = find_covered_cells(images[number], pixels[is_true])
    if not covered:
        return []
    everything = np.logical_or.reduce(list(covered.values()))
    left_out = everything & ~np.logical_or.reduce([covered[other] for other in chosen])
    added = {other: int((cells & left_out).sum()) for other, cells in covered.items()}
    best = max(added, key=lambda other: added[other])
    is_worth = added[best] > 0 and added[best] >= MIN_ADDED_CELLS * everything.sum()
    return [best] if is_worth else []


def find_covered_cells(image: StereoImage, pixels: Pixels) -> Bool[np.ndarray, "cells cells"]:
    """Find the cells of an image that matches lie in; none if there are few."""
    cells = np.zeros((COVERAGE_CELLS, COVERAGE_CELLS), bool)
    if len(pixels) >= MIN_COVERING_MATCHES:
        height, width = image.size
        columns, rows = (
            (pixels * COVERAGE_CELLS / [width, height]).astype(int).clip(0, COVERAGE_CELLS - 1).T
        )
        cells[rows, columns] = True
    return cells


def find_close_pairs(images: Sequence[StereoImage]) -> list[Pair]:
    """List pairs i < j with a baseline and a similar position and direction."""
    centers = np.stack([image.center for image in images])
    forward = np.stack([image.rotation[:, 2] for image in images])
    return find_near_pairs(centers, forward, NUM_COMPARED)


def sort_pairs(pairs: Iterable[Pair]) -> list[Pair]:
    """Sort pairs and remove duplicates, the smaller number first."""
    return sorted({(min(pair), max(pair)) for pair in pairs})


def score_pair(a: StereoImage, b: StereoImage, in_a: Pixels, in_b: Pixels) -> float:
    """Score two photographs by the triangulation angles of their matches, each up to 1."""
    if len(in_a) == 0:
        return 0.0
    # Baseline over depth; half of it is the tangent of half the angle at a point between both.
    ratio = float(np.linalg.norm(a.center - b.center)) * triangulate_valid(a, b, in_a, in_b)
    excess = np.degrees(2 * np.arctan(ratio / 2)) - BEST_STEREO_ANGLE
    sigma = np.where(excess < 0, NARROWER_SIGMA, WIDER_SIGMA)
    return float(np.exp(-((excess / sigma) ** 2) / 2).sum())
