"""The depth range of a scene that was given, and what its photographs show beyond it.

Stereo searches between near and far. A near plane behind a sofa's arm presses it to the plane or
throws it to the far end, which costs 4 dB. So a range is widened to what matched features, or given
depths, show.

A single wrong match may stand at any depth. Only matches that others beside them confirm count, and
only if 2 % of these lie outside.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from gscompleter.reconstructors.features.depth_range import (
    MARGINS,
    MIN_RANGE_MATCHES,
    SHARE_OUTSIDE,
    get_depth_range,
    get_given_range,
    measure_feature_depths,
)
from gscompleter.reconstructors.features.matches import Pixels, triangulate
from gscompleter.reconstructors.features.neighbours import find_neighbours
from gscompleter.reconstructors.features.stereo_image import make_stereo_images
from gscompleter.system.errors import InputError, format_rounded
from gscompleter.types import View

NEIGHBOURHOOD = 0.1
"""Half the side of the square, in widths of the image, in which matches confirm each other."""
SAME_DEPTH = math.log(1.25)
"""Largest difference in the logarithm of depth between matches that confirm each other."""
MAX_WIDENING = 100.0
"""Largest factor by which a plane is moved. Depths farther off are damaged, or in another unit."""
MIN_CONFIRMING = 2
"""Fewest other matches that confirm one."""


@dataclass(frozen=True)
class DepthRange:
    """Near and far z-depth of a scene, in scene units."""

    near: float
    far: float
    notes: tuple[str, ...] = ()
    """Sentences about what contradicts the range that was given or that Ψ was trained on."""


@dataclass(frozen=True)
class SeenDepths:
    """Depths that photographs show."""

    source: str
    """What shows them, as the beginning of a sentence."""
    inverse: Float[np.ndarray, "n"]
    """Inverse z-depths, in 1 / scene unit."""

    def find_nearest(self, near: float) -> float | None:
        """Find the depth of the nearest 2 %; None if they do not lie before the near plane."""
        if len(self.inverse) < MIN_RANGE_MATCHES:
            return None
        nearest = 1 / float(np.quantile(self.inverse, 1 - SHARE_OUTSIDE))
        return nearest if nearest < near else None

    def find_farthest(self, far: float) -> float | None:
        """Find the depth of the farthest 2 %; None if they do not lie behind the far plane."""
        if len(self.inverse) < MIN_RANGE_MATCHES:
            return None
        farthest = 1 / float(np.quantile(self.inverse, SHARE_OUTSIDE))
        return farthest if farthest > far else None


def find_depth_range(
    views: Sequence[View], trained: tuple[float, float] | None = None, keeps: bool = False
) -> DepthRange:
    """Find near and far z-depth of a scene, in scene units, and say what contradicts them.

    They are those of the cameras; else those that Ψ was `trained` on; else those of matched
    features. A given one is widened to what photographs show, unless Ψ `keeps` it. Raise InputError
    for an empty range.
    """
    known = get_given_range(views)
    if trained is None:
        found = DepthRange(*get_depth_range(views))
    else:
        found = DepthRange(*get_depth_range(views, lambda _: trained))
        if None in known:
            return replace(found, notes=describe_untrained_range(views, found))
    # Found above; or the range that the authors of a network give every scene in their evaluation,
    # where a sentence would come with each of them.
    if known in ((None, None), trained):
        return found
    if not keeps:
        return widen_range(views, found)
    widened = widen_range(views, found, "this model gets the range as it was given")
    return replace(found, notes=widened.notes)


def widen_range(views: Sequence[View], given: DepthRange, outcome: str = "") -> DepthRange:
    """Widen a range that matched features or given depths contradict, and say so.

    With few of them the range is believed. `outcome` is the end of the sentence; that the range was
    widened if it is empty.
    """
    near = given.near
    far = given.far
    notes = given.notes
    for seen in (measure_features(views), measure_given(views)):
        nearest, farthest = seen.find_nearest(near), seen.find_farthest(far)
        off = max(near / (nearest or near), (farthest or far) / far)
        if off > MAX_WIDENING:
            notes = (
                *notes,
                f"{seen.source} stand {format_rounded(off, 2)} times outside of the depth range "
                f"from {format_rounded(near)} to {format_rounded(far)}, which is kept: they are "
                "damaged, or in another unit.",
            )
            continue
        places = []
        if nearest is not None:
            place = format_rounded(nearest, 2)
            places.append(f"at {place}, nearer than the near plane at {format_rounded(near)}")
            near = MARGINS[0] * nearest
        if farthest is not None:
            place = format_rounded(farthest, 2)
            places.append(f"at {place}, farther than the far plane at {format_rounded(far)}")
            far = MARGINS[1] * farthest
        if places:
            widened = f"{format_rounded(near, 2)} to {format_rounded(far)}"
            end = outcome or f"the depth range was widened to {widened}"
            notes = (*notes, f"{seen.source} stand {' and '.join(places)}: {end}.")
    return DepthRange(near, far, notes)


def describe_untrained_range(views: Sequence[View], trained: DepthRange) -> tuple[str, ...]:
    """Say that the scene's features lie outside of the depths that Ψ was trained on.

    Published networks sweep planes between depths that their authors chose. A scene in another
    unit, as of COLMAP, has its surfaces elsewhere, and the networks cannot see it.
    """
    depths = None
    with suppress(InputError):  # No features without a baseline
        depths = measure_feature_depths(views)
    if depths is None:
        return ()
    nearest, farthest = depths
    # The geometric mean decides: the farthest features are often mismatches.
    middle = math.sqrt(nearest * farthest)
    if trained.near <= middle <= trained.far:
        return ()
    factor = math.sqrt(trained.near * trained.far) / middle
    return (
        f"The scene lies at depths from {format_rounded(nearest, 2)} to "
        f"{format_rounded(farthest, 2)}, and this model was trained on {trained.near:g} to "
        f"{trained.far:g}: multiply the positions of the cameras by about "
        f"{format_rounded(factor)}, or give near and far.",
    )


def measure_features(views: Sequence[View]) -> SeenDepths:
    """Measure the depths of matched features that others confirm; none without a baseline."""
    inverses = [np.zeros(0)]
    if len(views) < 2:
        return SeenDepths("Matched features", inverses[0])
    with suppress(InputError):
        images, unit = make_stereo_images(views)
        neighbours = find_neighbours(images)
        for i, j in neighbours.pairs:
            in_i, in_j = neighbours.matches[i, j]
            # Each match has a depth in either photograph of the pair.
            for a, b, in_a, in_b in ((i, j, in_i, in_j), (j, i, in_j, in_i)):
                inverse, is_valid = triangulate(images[a], images[b], in_a, in_b)
                inverse = inverse[is_valid]
                is_confirmed = find_confirmed(in_a[is_valid], inverse, images[a].size[1])
                # They are per widest baseline.
                inverses.append(inverse[is_confirmed] / unit)
    return SeenDepths("Matched features", np.concatenate(inverses))


def measure_given(views: Sequence[View]) -> SeenDepths:
    """Measure the depths that are given with the photographs."""
    known = [view.known_depths.cpu().double().numpy() for view in views]
    return SeenDepths("Given depths", 1 / np.concatenate(known))


def find_confirmed(
    pixels: Pixels, inverse: Float[np.ndarray, "m"], width: int
) -> Bool[np.ndarray, "m"]:
    """Find matches whose depth enough others in their neighbourhood confirm."""
    apart = np.abs(pixels[:, None] - pixels[None]).max(axis=-1)
    log_ratio = np.abs(np.log(inverse[:, None] / inverse[None]))
    is_alike = (apart <= NEIGHBOURHOOD * width) & (log_ratio <= SAME_DEPTH)
    # Each one is alike itself.
    return is_alike.sum(axis=1) > MIN_CONFIRMING
