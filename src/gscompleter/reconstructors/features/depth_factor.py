"""The factor between given depths and the unit of the cameras, from depths measured beside them.

Sensors measure in metres, cameras often have the arbitrary unit of structure from motion, and files
state wrong units. All of these are one factor for the whole scene. A factor for each photograph, as
of relative depth, or an inverted depth is none, and cannot be used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.numerics.robust import MAD_TO_SIGMA
from gscompleter.reconstructors.features.matches import triangulate
from gscompleter.reconstructors.features.neighbours import find_neighbours
from gscompleter.reconstructors.features.stereo_image import (
    has_distinct_centers,
    make_stereo_images,
)
from gscompleter.types import View

MIN_SAMPLES = 24
"""Fewest compared depths from which a factor is estimated."""
MIN_OWN_SAMPLES = 12
"""Fewest compared depths from which a single photograph is judged."""
# Ratios are compared by their natural logarithms: those of r and 1 / r are equally far from 0.
RATIO_WINDOW = np.log(1.1)
"""Half the width of the window, in logarithms, that is moved to where most ratios lie."""
AGREEMENT = np.log(1.25)
"""Largest deviation of a logarithm that agrees with the factor. Stereo is as inexact as the poses:
between photographs 0 and 2 of redkitchen, 85 % of the matches are that close to the sensor's depth,
and 62 % within 10 % of it."""
MIN_AGREEMENT = 0.5
"""Smallest share of the compared depths that must agree with a factor. In a single photograph the
same share tells that it has another one, as relative depth has in each."""
MIN_CORRELATION = -0.3
"""Smallest rank correlation of given and measured depths. Inverted depth comes near -1."""
CORRELATION_SIGMAS = 3.0
"""Standard deviations of the rank correlation of unrelated depths, such as those of a flat wall,
beyond which a smaller one is no chance."""
POSE_NOISE = np.log(1.1)
"""Largest logarithm that counts as no factor: errors of poses scale all depths of a pair."""


@dataclass(frozen=True)
class DepthSamples:
    """Depths that are given and measured at the same pixels."""

    given: Float[np.ndarray, "n"]
    """z-depth in the unit of its file."""
    measured: Float[np.ndarray, "n"]
    """z-depth in scene units."""
    photograph: Int[np.ndarray, "n"]
    """Index of the photograph of each pixel."""

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.given)

    def select(self, photograph: int) -> DepthSamples:
        """Select the samples of one photograph."""
        is_own = self.photograph == photograph
        return DepthSamples(self.given[is_own], self.measured[is_own], self.photograph[is_own])


@dataclass(frozen=True)
class DepthFactor:
    """The factor from given depths to scene units."""

    factor: float
    """1 if the given depths are in scene units, as far as the measurement shows."""
    agreement: float
    """Share of the samples that agree with it."""
    is_consistent: bool
    """True if one factor explains the samples."""


def join_samples(parts: Sequence[DepthSamples]) -> DepthSamples:
    """Concatenate samples."""
    nothing = np.zeros(0)
    nowhere = np.zeros(0, int)
    return DepthSamples(
        np.concatenate([nothing, *(part.given for part in parts)]),
        np.concatenate([nothing, *(part.measured for part in parts)]),
        np.concatenate([nowhere, *(part.photograph for part in parts)]),
    )


def compare_maps(
    given: Float[Tensor, "h w"], measured: Float[Tensor, "h w"], photograph: int
) -> DepthSamples:
    """Compare two depth maps of a photograph where both are known (above 0)."""
    known = (given > 0) & (measured > 0)
    return DepthSamples(
        given[known].double().numpy(),
        measured[known].double().numpy(),
        np.full(int(known.sum()), photograph),
    )


def compare_with_matches(
    views: Sequence[View], depths: Sequence[Float[Tensor, "h w"]]
) -> DepthSamples:
    """Compare depth maps with the triangulated feature matches of neighbouring photographs.

    Features are used instead of the plane sweep: it searches between a near and a far plane, and
    these may come from the very depths that are compared. Photographs of one place, or a single
    one, measure nothing. Views and depth maps are on the CPU; a map has the size of its photograph,
    and 0 where nothing is known.
    """
    if len(views) < 2 or not has_distinct_centers(views):
        return join_samples([])
    images, unit = make_stereo_images(views)
    neighbours = find_neighbours(images)
    parts = []
    for i, j in neighbours.pairs:
        # Each match gives a depth in either photograph of the pair. A pixel (x, y) lies in column
        # floor(x) and row floor(y); stereo images have the size of their photographs.
        in_i, in_j = neighbours.matches[i, j]
        for a, b, in_a, in_b in ((i, j, in_i, in_j), (j, i, in_j, in_i)):
            if len(in_a) == 0:
                continue
            # Inverse z-depths, one over the widest baseline, whose length is `unit`.
            inverse, is_valid = triangulate(images[a], images[b], in_a, in_b)
            columns, rows = in_a.astype(int).T
            given = depths[a].numpy()[rows, columns].astype(np.float64)
            known = is_valid & (given > 0)
            number = np.full(int(known.sum()), a)
            parts.append(DepthSamples(given[known], unit / inverse[known], number))
    return join_samples(parts)


def fit_depth_factor(samples: DepthSamples) -> DepthFactor | None:
    """Fit the factor by which given depths are multiplied; None if there are too few samples.

    The densest cluster of ratios decides, rather than the median of all: points may be hidden by
    the surface that the map shows, and matches be false, on one side more than on the other.
    """
    if len(samples) < MIN_SAMPLES:
        return None
    ratios = np.log(samples.measured) - np.log(samples.given)
    log_factor = find_densest(ratios)

    # A factor within the noise of the poses, or of the ratios themselves, counts as 1, unless the
    # samples do not agree with that. The noise is the spread of single ratios, though the factor is
    # a median of many: the errors of a pair's pose are common to all its depths, so that more of
    # them do not average out.
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(ratios - log_factor)))
    is_within_noise = abs(log_factor) <= max(POSE_NOISE, sigma)
    if is_within_noise and compute_agreement(ratios, 0.0) >= MIN_AGREEMENT:
        log_factor = 0.0

    agreement = compute_agreement(ratios, log_factor)
    is_consistent = agreement >= MIN_AGREEMENT and not is_inverted(samples)
    for number in np.flatnonzero(np.bincount(samples.photograph) >= MIN_OWN_SAMPLES).tolist():
        is_consistent = is_consistent and not contradicts_factor(samples.select(number), log_factor)
    return DepthFactor(float(np.exp(log_factor)), agreement, is_consistent)


def find_densest(ratios: Float[np.ndarray, "n"]) -> float:
    """Find the median of the ratios in the fullest window.

    Windows are `RATIO_WINDOW` wide to either side of one of the ratios, which are logarithms.
    """
    ordered = np.sort(ratios)
    first = np.searchsorted(ordered, ordered - RATIO_WINDOW)
    last = np.searchsorted(ordered, ordered + RATIO_WINDOW)
    center = ordered[(last - first).argmax()]
    return float(np.median(ratios[np.abs(ratios - center) <= RATIO_WINDOW]))


def compute_agreement(ratios: Float[np.ndarray, "n"], log_factor: float) -> float:
    """Compute the share of logarithms of ratios that agree with a factor."""
    return float((np.abs(ratios - log_factor) <= AGREEMENT).mean())


def contradicts_factor(samples: DepthSamples, log_factor: float) -> bool:
    """Return True if the samples of one photograph tell that it has another factor, or none.

    Samples that agree with no factor at all prove nothing: they come from a pair with a wrong pose
    or a short baseline, whose triangulated depths scatter (a photograph of redkitchen has 0.42 to
    0.83 of the sensor's depth between the 10 % and 90 % quantiles).
    """
    ratios = np.log(samples.measured) - np.log(samples.given)
    if compute_agreement(ratios, log_factor) >= MIN_AGREEMENT:
        return False
    in_core = np.abs(ratios - find_densest(ratios)) <= RATIO_WINDOW
    return bool(in_core.mean() >= MIN_AGREEMENT) or is_inverted(samples)


def is_inverted(samples: DepthSamples) -> bool:
    """Return True if given depths fall where measured ones rise, and not by chance."""
    # The rank correlation of n unrelated pairs has the variance 1 / (n - 1).
    chance = CORRELATION_SIGMAS / math.sqrt(len(samples) - 1)
    return correlate_ranks(samples) < min(MIN_CORRELATION, -chance)


def correlate_ranks(samples: DepthSamples) -> float:
    """Compute Spearman's rank correlation of given and measured depths; 0 if one is constant."""
    given = rank_values(samples.given)
    measured = rank_values(samples.measured)
    if np.ptp(given) == 0 or np.ptp(measured) == 0:
        return 0.0
    return float(np.corrcoef(given, measured)[0, 1])


def rank_values(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Rank values; equal ones share their mean rank.

    `scipy.stats.rankdata` gives the same, and its import takes longer than a tenth of a completion.
    """
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    return (last - (count - 1) / 2)[place]
