"""Stereo depth of each view, before surfaces are fitted."""

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
"""Shortest image side, in pixels, from which a half-size sweep narrows the search."""
BACKGROUND_WEIGHT = np.float32(0.3)
"""Weight of a background depth at pixels occluded in the other views."""


@dataclass(frozen=True)
class Sweep:
    """The best plane of each pixel of one view."""

    planes: Planes
    index: Map
    """Best plane, to a fraction."""
    margin: Map
    """Cost gap to the second best plane."""

    @cached_property
    def inverse(self) -> Map:
        """Inverse depths of the best planes."""
        return inverse_at(self.planes, self.index)


@dataclass(frozen=True)
class Measured:
    """The plane of each pixel of one view, with weights."""

    planes: Planes
    index: Map
    weight: Map
    """Weight for the surface fit, in [0, 1]."""
    confidence: Map
    """Like `weight`, but 0 for depths taken from surrounding pixels."""

    def at_size(self, size: tuple[int, int]) -> Measured:
        """Upsample to `size` if the image was halved."""
        if self.index.shape == size:
            return self
        index, weight, confidence = (
            doubled(values, size) for values in (self.index, self.weight, self.confidence)
        )
        return replace(self, index=index, weight=weight, confidence=confidence)


def measured(rig: Rig, near: float, far: float) -> list[Measured]:
    """Measure the depth of each view, between two z-depths in scene units."""
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
    """Sweep all views, coarse to fine; `near` and `far` are in widest baselines."""
    numbers = range(len(rig.images))
    if min(min(image.size) for image in rig.images) < GUIDED_FROM:
        return [swept(i, rig, near, far) for i in numbers]
    guesses = sweeps_of(rig.halved(), near, far)
    return [swept(i, rig, near, far, guesses[i]) for i in numbers]


def swept(number: int, rig: Rig, near: float, far: float, guess: Sweep | None = None) -> Sweep:
    """Find the best planes of one view, near the half-size `guess` if there is one."""
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
    """Compute the confidence of each view; 0 for pixels that no other view confirms."""
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
    """Give pixels occluded in the other views (inverse depths `sure`) the background depth."""
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
    """Convert plane indices to inverse depths, at most twice as far as the last plane."""
    step = planes[1] - planes[0]
    within = index.clip(-0.5, len(planes) - 0.5)
    return np.maximum(planes[0] + within * step, planes[0] / 2).astype(np.float32)


def fractions(planes: Planes, inverse: Map) -> Map:
    """Convert inverse depths to plane indices."""
    return ((inverse - planes[0]) / (planes[1] - planes[0])).astype(np.float32)


def doubled(values: Map, size: tuple[int, int]) -> Map:
    """Repeat each pixel 2 x 2 and crop to `size`."""
    return np.ascontiguousarray(values.repeat(2, axis=0).repeat(2, axis=1)[: size[0], : size[1]])
