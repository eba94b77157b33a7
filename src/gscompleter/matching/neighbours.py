"""Which photographs each photograph is matched with: those that tell most of its depth.

Schönberger et al. (ECCV 2016) choose by features that two images share and by the angle at which
their rays meet: without an angle there is no depth, and across a wide one surfaces look different.
Only photographs taken from near and in a like direction are asked, so that the time grows with the
number of photographs and not with its square.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gscompleter.kernels.sharing import side_by_side
from gscompleter.matching.features import Pixels, features_of, matches
from gscompleter.matching.stereo_image import StereoImage
from gscompleter.matching.triangulation import inverse_depths

COUNT = 2
"""Photographs that each one is matched with."""
CANDIDATES = 6
"""Photographs close to each one whose features are compared with its own."""
TURN = 15.0
"""Degrees between two viewing directions that make them as unlike as standing two steps apart."""
ANGLE = 5.0
"""Degrees at which the rays to a feature meet best."""
NARROWER, WIDER = 2.0, 10.0
"""Degrees less and more than that, at which a feature has lost two fifths of its worth."""
NO_FEATURE = 1e-6
"""Worth of a photograph with which no feature is shared: better than none."""

Pair = tuple[int, int]
Matches = dict[Pair, tuple[Pixels, Pixels]]
"""Pixels of the same features in photographs i < j."""


@dataclass(frozen=True)
class Neighbours:
    """Who is matched with whom."""

    of: tuple[tuple[int, ...], ...]
    """The photographs that each one is matched with, the best one first."""
    matches: Matches
    """Features that were found in both, for all pairs that were compared."""

    @property
    def pairs(self) -> list[Pair]:
        """Photographs i < j of which one is matched with the other."""
        return ascending((i, j) for i, others in enumerate(self.of) for j in others)

    def either_way(self, number: int) -> list[int]:
        """Those that photograph `number` is matched with, or that are matched with it."""
        back = {other for other, chosen in enumerate(self.of) if number in chosen}
        return sorted(back | set(self.of[number]))


def neighbours_among(images: Sequence[StereoImage], count: int = COUNT) -> Neighbours:
    """Up to `count` photographs to match each of `images` with."""
    features = side_by_side(features_of, images)
    found = {(i, j): matches(features[i], features[j]) for i, j in close_pairs(images)}
    worth = np.zeros((len(images), len(images)))
    for (i, j), pixels in found.items():
        worth[i, j] = worth[j, i] = NO_FEATURE + shared_worth(images[i], images[j], *pixels)
    ranked = (-worth).argsort(axis=1, kind="stable")[:, :count]
    chosen = [tuple(int(j) for j in row if worth[i, j] > 0) for i, row in enumerate(ranked)]
    return Neighbours(tuple(chosen), found)


def close_pairs(images: Sequence[StereoImage]) -> list[Pair]:
    """Pairs i < j with a baseline, of which one is among those that are most like the other by
    where they stand and look."""
    centers = np.stack([image.center for image in images])
    forward = np.stack([image.rotation[:, 2] for image in images])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    turned = np.degrees(np.arccos((forward @ forward.T).clip(-1, 1)))
    apart[apart == 0] = np.inf
    step = np.median(apart.min(axis=1))
    unlike = apart / step + 2 * turned / TURN
    nearest = unlike.argsort(axis=1, kind="stable")[:, :CANDIDATES]
    pairs = {(i, int(j)) for i, row in enumerate(nearest) for j in row if np.isfinite(unlike[i, j])}
    return ascending(pairs)


def ascending(pairs: Iterable[Pair]) -> list[Pair]:
    """Each of `pairs` once, the smaller number first."""
    return sorted({(min(pair), max(pair)) for pair in pairs})


def shared_worth(a: StereoImage, b: StereoImage, in_a: Pixels, in_b: Pixels) -> float:
    """How much two photographs tell of depth by the features that they share."""
    if len(in_a) == 0:
        return 0.0
    baseline = float(np.linalg.norm(a.center - b.center))
    return float(angle_worth(baseline * inverse_depths(a, b, in_a, in_b)).sum())


def angle_worth(ratio: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Worth, up to 1, of features whose depth is that many baselines away, inverted."""
    excess = np.degrees(2 * np.arctan(ratio / 2)) - ANGLE
    return np.exp(-((excess / np.where(excess < 0, NARROWER, WIDER)) ** 2) / 2)
