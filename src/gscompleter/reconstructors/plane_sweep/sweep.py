"""Stereo depth of each view, before surfaces are fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from gscompleter.kernels import stereo
from gscompleter.reconstructors.plane_sweep.aggregation import aggregate
from gscompleter.reconstructors.plane_sweep.confidence import compute_confidence, find_consistent
from gscompleter.reconstructors.plane_sweep.depth_bands import make_full_bands, make_guided_bands
from gscompleter.reconstructors.plane_sweep.matching import compute_costs, place_planes
from gscompleter.reconstructors.plane_sweep.occlusion import UNKNOWN, Neighbour, find_hidden
from gscompleter.reconstructors.plane_sweep.rig import Rig

Map = Float32[np.ndarray, "_ _"]
Planes = Float32[np.ndarray, "d"]
"""Inverse depths from far to near, evenly spaced."""
MIN_GUIDED_SIDE = 192
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
        return compute_inverse_depth(self.planes, self.index)


@dataclass(frozen=True)
class Measurement:
    """The plane of each pixel of one view, with weights."""

    planes: Planes
    index: Map
    weight: Map
    """Weight for the surface fit, in [0, 1]."""
    confidence: Map
    """Like `weight`, but 0 for depths taken from surrounding pixels."""

    def resize_to(self, size: tuple[int, int]) -> Measurement:
        """Upsample to `size` if the image was halved."""
        if self.index.shape == size:
            return self
        index, weight, confidence = (
            repeat_pixels(values, size) for values in (self.index, self.weight, self.confidence)
        )
        return replace(self, index=index, weight=weight, confidence=confidence)


def measure_depths(rig: Rig, near: float, far: float) -> list[Measurement]:
    """Measure the depth of each view, between two z-depths in scene units."""
    sweeps = sweep_views(rig, near / rig.unit, far / rig.unit)
    confidences = compute_confidences(sweeps, rig)
    sure = [
        np.where(confidence > 0, sweep.inverse, UNKNOWN)
        for sweep, confidence in zip(sweeps, confidences, strict=True)
    ]
    return [
        add_background(i, sweep, confidence, sure, rig)
        for i, (sweep, confidence) in enumerate(zip(sweeps, confidences, strict=True))
    ]


def sweep_views(rig: Rig, near: float, far: float) -> list[Sweep]:
    """Sweep all views, coarse to fine; `near` and `far` are in widest baselines."""
    numbers = range(len(rig.images))
    if min(min(image.size) for image in rig.images) < MIN_GUIDED_SIDE:
        return [sweep_view(i, rig, near, far) for i in numbers]
    guesses = sweep_views(rig.halve(), near, far)
    return [sweep_view(i, rig, near, far, guesses[i]) for i in numbers]


def sweep_view(number: int, rig: Rig, near: float, far: float, guess: Sweep | None = None) -> Sweep:
    """Find the best planes of one view, near the half-size `guess` if there is one."""
    image = rig.images[number]
    sources = [
        (rig.images[i], rig.transforms[number, i]) for i in rig.neighbours.neighbours_of[number]
    ]
    planes = place_planes(image, sources, near, far)
    bands = make_full_bands(image.size, len(planes))
    if guess is not None:
        likely = compute_plane_index(planes, guess.inverse)
        bands = make_guided_bands(likely, 2, image.size, len(planes))
    costs = compute_costs(image, sources, planes, bands)
    index, margin = stereo.select_planes(aggregate(costs, bands, image), bands, *image.size)
    if guess is not None:
        margin = np.minimum(margin, repeat_pixels(guess.margin, image.size))
    return Sweep(planes, index, margin)


def compute_confidences(sweeps: Sequence[Sweep], rig: Rig) -> list[Map]:
    """Compute the confidence of each view; 0 for pixels that no other view confirms."""
    inverses = [sweep.inverse for sweep in sweeps]
    confidences = []
    for i, sweep in enumerate(sweeps):
        agrees = np.zeros(inverses[i].shape, bool)
        for j in rig.neighbours.find_partners(i):
            there, back = rig.transforms[i, j], rig.transforms[j, i]
            agrees |= find_consistent(inverses[i], inverses[j], there, back)
        confidences.append(compute_confidence(sweep.index, sweep.margin, agrees))
    return confidences


def add_background(
    number: int, sweep: Sweep, confidence: Map, sure: Sequence[Map], rig: Rig
) -> Measurement:
    """Give pixels occluded in the other views (inverse depths `sure`) the background depth."""
    background = stereo.fill_background(sweep.index, confidence > 0)
    neighbours = [
        Neighbour(sure[i], rig.transforms[number, i], rig.transforms[i, number])
        for i in rig.neighbours.find_partners(number)
    ]
    behind = compute_inverse_depth(sweep.planes, background)
    occluded = (confidence == 0) & find_hidden(behind, neighbours)
    weight = np.where(occluded, BACKGROUND_WEIGHT, confidence)
    index = np.where(occluded, background, sweep.index)
    return Measurement(sweep.planes, index, weight, confidence)


def compute_inverse_depth(planes: Planes, index: Map) -> Map:
    """Convert plane indices to inverse depths, at most twice as far as the last plane."""
    step = planes[1] - planes[0]
    within = index.clip(-0.5, len(planes) - 0.5)
    return np.maximum(planes[0] + within * step, planes[0] / 2).astype(np.float32)


def compute_plane_index(planes: Planes, inverse: Map) -> Map:
    """Convert inverse depths to plane indices."""
    return ((inverse - planes[0]) / (planes[1] - planes[0])).astype(np.float32)


def repeat_pixels(values: Map, size: tuple[int, int]) -> Map:
    """Repeat each pixel 2 x 2 and crop to `size`."""
    return np.ascontiguousarray(values.repeat(2, axis=0).repeat(2, axis=1)[: size[0], : size[1]])
