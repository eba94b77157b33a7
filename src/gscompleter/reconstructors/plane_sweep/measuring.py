"""What stereo measures in each of the views, before surfaces are made of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from gscompleter.kernels import stereo
from gscompleter.reconstructors.plane_sweep.aggregation import aggregate
from gscompleter.reconstructors.plane_sweep.bands import around, every_plane
from gscompleter.reconstructors.plane_sweep.confidence import confidence_of, consistent
from gscompleter.reconstructors.plane_sweep.matching import (
    inverse_depth_planes,
    matched_costs,
)
from gscompleter.reconstructors.plane_sweep.occlusion import (
    UNKNOWN,
    Neighbour,
    hidden_from_others,
)
from gscompleter.reconstructors.plane_sweep.rig import Rig

Map = Float32[np.ndarray, "_ _"]
Planes = Float32[np.ndarray, "d"]
"""Inverse depths from far to near, evenly spaced."""
GUIDED_FROM = 192
"""Pixels of the shortest side from which images of half the size say first where to look."""
BACKGROUND_WEIGHT = np.float32(0.3)
"""How much the background's depth counts where an object hides it from the other views."""


@dataclass(frozen=True)
class Sweep:
    """The planes that match best in one view."""

    planes: Planes
    index: Map
    """The best plane of each pixel, to a fraction."""
    margin: Map
    """How much more the second best costs."""

    @cached_property
    def inverse(self) -> Map:
        """Inverse depths of the best planes."""
        return inverse_at(self.planes, self.index)


@dataclass(frozen=True)
class Measured:
    """The planes of one view's pixels, and how far they count."""

    planes: Planes
    index: Map
    """The plane of each pixel, to a fraction."""
    weight: Map
    """How much it counts for surfaces, in [0, 1]."""
    confidence: Map
    """The same, and 0 where it was told by what surrounds the pixel."""

    def at_size(self, size: tuple[int, int]) -> Measured:
        """The same for an image of `size`, which may have been halved."""
        if self.index.shape == size:
            return self
        index, weight, confidence = (
            doubled(values, size) for values in (self.index, self.weight, self.confidence)
        )
        return replace(self, index=index, weight=weight, confidence=confidence)


def measured(rig: Rig, near: float, far: float) -> list[Measured]:
    """What matching says of each view, between z-depths in scene units."""
    sweeps = sweeps_of(rig, near / rig.unit, far / rig.unit)
    confidences = confidences_of(sweeps, rig)
    sure = [
        np.where(confidence > 0, sweep.inverse, UNKNOWN)
        for sweep, confidence in zip(sweeps, confidences, strict=True)
    ]
    return [
        with_background(i, sweep, confidence, sure, rig)
        for i, (sweep, confidence) in enumerate(zip(sweeps, confidences, strict=True))
    ]


def sweeps_of(rig: Rig, near: float, far: float) -> list[Sweep]:
    """The planes that match best in each view, between depths in widest baselines.

    A pyramid: what images of half the size say leaves a band of planes to each tile.
    """
    numbers = range(len(rig.images))
    if min(min(image.size) for image in rig.images) < GUIDED_FROM:
        return [swept(i, rig, near, far) for i in numbers]
    guesses = sweeps_of(rig.halved(), near, far)
    return [swept(i, rig, near, far, guesses[i]) for i in numbers]


def swept(number: int, rig: Rig, near: float, far: float, guess: Sweep | None = None) -> Sweep:
    """The planes that match best in view `number`, between depths in widest baselines.

    `guess` is what an image of half the size says; only planes around it are looked at then.
    """
    image = rig.images[number]
    sources = [(rig.images[i], rig.transforms[number, i]) for i in rig.neighbours.of[number]]
    planes = inverse_depth_planes(image, sources, near, far)
    bands = every_plane(image.size, len(planes))
    if guess is not None:
        likely = fractions(planes, guess.inverse)
        bands = around(likely, 2, image.size, len(planes))
    costs = matched_costs(image, sources, planes, bands)
    index, margin = stereo.winners(aggregate(costs, bands, image), bands, *image.size)
    if guess is not None:
        margin = np.minimum(margin, doubled(guess.margin, image.size))
    return Sweep(planes, index, margin)


def confidences_of(sweeps: Sequence[Sweep], rig: Rig) -> list[Map]:
    """How much each pixel's match counts: 0 where no other view agrees with it."""
    inverses = [sweep.inverse for sweep in sweeps]
    confidences = []
    for i, sweep in enumerate(sweeps):
        agrees = np.zeros(inverses[i].shape, bool)
        for j in rig.neighbours.either_way(i):
            there, back = rig.transforms[i, j], rig.transforms[j, i]
            agrees |= consistent(inverses[i], inverses[j], there, back)
        confidences.append(confidence_of(sweep.index, sweep.margin, agrees))
    return confidences


def with_background(
    number: int, sweep: Sweep, confidence: Map, sure: Sequence[Map], rig: Rig
) -> Measured:
    """The planes of view `number`, those of what is hidden from the other views too.

    `sure` are the inverse depths of all views, next to 0 where a view is not sure of them.
    """
    background = stereo.background(sweep.index, confidence > 0)
    neighbours = [
        Neighbour(sure[i], rig.transforms[number, i], rig.transforms[i, number])
        for i in rig.neighbours.either_way(number)
    ]
    behind = inverse_at(sweep.planes, background)
    occluded = (confidence == 0) & hidden_from_others(behind, neighbours)
    weight = np.where(occluded, BACKGROUND_WEIGHT, confidence)
    index = np.where(occluded, background, sweep.index)
    return Measured(sweep.planes, index, weight, confidence)


def inverse_at(planes: Planes, index: Map) -> Map:
    """Inverse depths at fractions of `planes`, none farther than twice the farthest plane."""
    step = planes[1] - planes[0]
    within = index.clip(-0.5, len(planes) - 0.5)
    return np.maximum(planes[0] + within * step, planes[0] / 2).astype(np.float32)


def fractions(planes: Planes, inverse: Map) -> Map:
    """Where inverse depths lie among `planes`."""
    return ((inverse - planes[0]) / (planes[1] - planes[0])).astype(np.float32)


def doubled(values: Map, size: tuple[int, int]) -> Map:
    """Each value four times, cut to `size`."""
    return np.ascontiguousarray(values.repeat(2, axis=0).repeat(2, axis=1)[: size[0], : size[1]])
