"""Depth range of a scene from feature matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from gscompleter.errors import InputError
from gscompleter.reconstructors.features.matches import triangulate_valid
from gscompleter.reconstructors.features.neighbours import Neighbours, find_neighbours
from gscompleter.reconstructors.features.stereo_image import StereoImage, make_stereo_images
from gscompleter.types import View

MIN_MATCHES = 12
"""Fewest triangulated features for an estimate."""


def estimate_depth_range(views: Sequence[View]) -> tuple[float, float]:
    """Estimate near and far z-depth of the scene, in scene units.

    They are half the depth of the nearest 2 % of the triangulated matches and four times that of
    the farthest 2 %. With too few matches they are derived from the baselines. For a single view
    the given depths take the place of matches.
    """
    if len(views) == 1 and len(views[0].known_depths):
        low, high = np.quantile(views[0].known_depths.cpu(), [0.02, 0.98]).tolist()
        return 0.5 * low, 4.0 * high
    images, unit = make_stereo_images(views)
    neighbours = find_neighbours(images)
    inverse = triangulate_neighbours(images, neighbours)
    if len(inverse) < MIN_MATCHES:
        near, far = derive_range_from_baselines(images, neighbours)
    else:
        low, high = np.quantile(inverse, [0.02, 0.98])
        near, far = 0.5 / high, 4.0 / low
    return near * unit, far * unit


def get_depth_range(
    views: Sequence[View],
    estimate: Callable[[Sequence[View]], tuple[float, float]] = estimate_depth_range,
) -> tuple[float, float]:
    """Return near and far z-depth of the first camera, estimated if unknown."""
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


def set_depth_range(views: Sequence[View], near: float, far: float) -> list[View]:
    """Set the depth range of all cameras, in scene units."""
    return [replace(view, camera=replace(view.camera, near=near, far=far)) for view in views]


def derive_range_from_baselines(
    images: Sequence[StereoImage], neighbours: Neighbours
) -> tuple[float, float]:
    """Derive a depth range from a parallax of 0.4 image widths and of a third of a pixel."""
    focal = float(np.median([image.K[0, 0] for image in images]))
    width = float(np.median([image.size[1] for image in images]))
    pairs = [(i, others[0]) for i, others in enumerate(neighbours.neighbours_of) if others]
    apart = [float(np.linalg.norm(images[i].center - images[j].center)) for i, j in pairs]
    baseline = float(np.median(apart))
    return baseline * focal / (0.4 * width), baseline * 3.0 * focal


def triangulate_neighbours(
    images: Sequence[StereoImage], neighbours: Neighbours
) -> Float[np.ndarray, "n"]:
    """Triangulate the matches of neighbouring views; inverse z-depth per widest baseline."""
    found = [np.zeros(0)]
    for i, j in neighbours.pairs:
        a, b = neighbours.matches[i, j]
        if len(a):
            found.append(triangulate_valid(images[i], images[j], a, b))
            found.append(triangulate_valid(images[j], images[i], b, a))
    return np.concatenate(found)
