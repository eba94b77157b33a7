"""How near and how far the scene lies, from matched features alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from gscompleter.errors import InputError
from gscompleter.matching.neighbours import Neighbours, neighbours_among
from gscompleter.matching.stereo_image import StereoImage, stereo_images
from gscompleter.matching.triangulation import inverse_depths
from gscompleter.types import View

MIN_MATCHES = 12
"""Fewest triangulated features that tell a depth range."""


def estimate_depth_range(views: Sequence[View]) -> tuple[float, float]:
    """Near and far z-depth, in scene units, that enclose what the views see.

    Features are matched between neighbours, checked against the known poses and triangulated; half
    of the nearest and four times the farthest percentile leave room for what carries no feature.
    With too few matches the baselines of neighbours set the range: from where they move a pixel by
    two fifths of the image, to where they move it by a third of a pixel.

    Raises:
        InputError: with fewer than two views, or where all of them stand in one place.
    """
    images, unit = stereo_images(views)
    neighbours = neighbours_among(images)
    inverse = triangulated(images, neighbours)
    if len(inverse) < MIN_MATCHES:
        near, far = range_from_baselines(images, neighbours)
    else:
        low, high = np.quantile(inverse, [0.02, 0.98])
        near, far = 0.5 / high, 4.0 / low
    return near * unit, far * unit


def depth_range_of(
    views: Sequence[View],
    estimate: Callable[[Sequence[View]], tuple[float, float]] = estimate_depth_range,
) -> tuple[float, float]:
    """Near and far z-depth, in scene units: as the first camera knows them, else estimated.

    Args:
        views: Photographs of one scene.
        estimate: Finds what the camera does not know; as it stands, from matched features.

    Raises:
        InputError: where the range is empty.
    """
    near, far = views[0].camera.near, views[0].camera.far
    if near is None or far is None:
        low, high = estimate(views)
        near, far = near if near is not None else low, far if far is not None else high
    if not 0 < near < far:
        raise InputError(
            f"The depth range {near:g} to {far:g} is empty; near must be positive and less "
            "than far."
        )
    return near, far


def range_from_baselines(
    images: Sequence[StereoImage], neighbours: Neighbours
) -> tuple[float, float]:
    """Depths (in widest baselines) at which a view still, and just no longer, matches another."""
    focal = float(np.median([image.K[0, 0] for image in images]))
    width = float(np.median([image.size[1] for image in images]))
    pairs = [(i, others[0]) for i, others in enumerate(neighbours.of) if others]
    apart = [float(np.linalg.norm(images[i].center - images[j].center)) for i, j in pairs]
    baseline = float(np.median(apart))
    return baseline * focal / (0.4 * width), baseline * 3.0 * focal


def triangulated(images: Sequence[StereoImage], neighbours: Neighbours) -> Float[np.ndarray, "n"]:
    """Inverse z-depths (per widest baseline) of the features that each view shares with the ones
    that tell most of its depth, where they agree with the epipolar geometry."""
    found = [np.zeros(0)]
    for i, j in neighbours.pairs:
        a, b = neighbours.matches[i, j]
        if len(a):
            found.append(inverse_depths(images[i], images[j], a, b))
            found.append(inverse_depths(images[j], images[i], b, a))
    return np.concatenate(found)
