"""Depth range of a scene from feature matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gscompleter.reconstructors.features.matches import triangulate_valid
from gscompleter.reconstructors.features.neighbours import Neighbours, find_neighbours
from gscompleter.reconstructors.features.stereo_image import StereoImage, make_stereo_images
from gscompleter.system.errors import InputError
from gscompleter.types import View

MIN_RANGE_MATCHES = 12
"""Fewest triangulated features for an estimate."""
MARGINS = (0.5, 4.0)
"""Near relative to the depth of the nearest features, and far to that of the farthest."""
SHARE_OUTSIDE = 0.02
"""Share of the features that lie before the nearest depth, and share behind the farthest: those
may be wrong."""


def estimate_depth_range(views: Sequence[View]) -> tuple[float, float]:
    """Estimate near and far z-depth of the scene, in scene units.

    They are half the depth of the nearest 2 % of the triangulated matches and four times that of
    the farthest 2 %. With too few matches they are derived from the baselines. For a single view
    the given depths take the place of matches.
    """
    if len(views) == 1 and len(views[0].known_depths):
        shares = [SHARE_OUTSIDE, 1 - SHARE_OUTSIDE]
        low, high = np.quantile(views[0].known_depths.cpu(), shares).tolist()
        return MARGINS[0] * low, MARGINS[1] * high
    # Stereo images are in units of the widest baseline, which is `unit` in scene units.
    images, unit = make_stereo_images(views)
    neighbours = find_neighbours(images)
    depths = measure_extreme_depths(images, neighbours)
    if depths is None:
        near, far = derive_range_from_baselines(images, neighbours)
        return near * unit, far * unit
    nearest, farthest = depths
    return MARGINS[0] * nearest * unit, MARGINS[1] * farthest * unit


def measure_feature_depths(views: Sequence[View]) -> tuple[float, float] | None:
    """Measure the z-depths of the nearest and farthest 2 % of the features, in scene units.

    None if too few are matched.
    """
    images, unit = make_stereo_images(views)
    depths = measure_extreme_depths(images, find_neighbours(images))
    return None if depths is None else (depths[0] * unit, depths[1] * unit)


def measure_extreme_depths(
    images: Sequence[StereoImage], neighbours: Neighbours
) -> tuple[float, float] | None:
    """Measure the depths of the nearest and farthest 2 % of the features; None for too few.

    Depths are z-depths in the unit of the images, their widest baseline.
    """
    # Inverse z-depths of the matches of neighbouring views, seen from either view.
    inverses = [np.zeros(0)]
    for i, j in neighbours.pairs:
        in_i, in_j = neighbours.matches[i, j]
        if len(in_i):
            inverses.append(triangulate_valid(images[i], images[j], in_i, in_j))
            inverses.append(triangulate_valid(images[j], images[i], in_j, in_i))
    inverse = np.concatenate(inverses)
    if len(inverse) < MIN_RANGE_MATCHES:
        return None
    # The nearest depth is the largest inverse depth.
    low, high = np.quantile(inverse, [SHARE_OUTSIDE, 1 - SHARE_OUTSIDE]).tolist()
    return 1 / high, 1 / low


def get_depth_range(
    views: Sequence[View],
    estimate: Callable[[Sequence[View]], tuple[float, float]] = estimate_depth_range,
) -> tuple[float, float]:
    """Return near and far z-depth of the cameras, in scene units, estimated if unknown."""
    near, far = get_given_range(views)
    if near is None or far is None:
        low, high = estimate(views)
        near = low if near is None else near
        far = high if far is None else far
    if not 0 < near < far:
        raise InputError(
            f"The depth range {near:g} to {far:g} is empty; near must be positive and less "
            "than far."
        )
    return near, far


def get_given_range(views: Sequence[View]) -> tuple[float | None, float | None]:
    """Return the nearest near and the farthest far plane of the cameras; None if none has one."""
    nears = [view.camera.near for view in views if view.camera.near is not None]
    fars = [view.camera.far for view in views if view.camera.far is not None]
    return min(nears, default=None), max(fars, default=None)


def set_depth_range(views: Sequence[View], near: float, far: float) -> list[View]:
    """Set the depth range of all cameras, in scene units."""
    return [replace(view, camera=replace(view.camera, near=near, far=far)) for view in views]


def derive_range_from_baselines(
    images: Sequence[StereoImage], neighbours: Neighbours
) -> tuple[float, float]:
    """Derive near from a parallax of 0.4 image widths, and far from one of a third of a pixel.

    A parallax of p pixels has the depth baseline · focal / p. The baseline is the median over each
    view and its best neighbour, in the unit of the images, as is the result.
    """
    focal = float(np.median([image.K[0, 0] for image in images]))
    width = float(np.median([image.size[1] for image in images]))
    pairs = [(i, others[0]) for i, others in enumerate(neighbours.neighbours_of) if others]
    baselines = [float(np.linalg.norm(images[i].center - images[j].center)) for i, j in pairs]
    baseline = float(np.median(baselines))
    return baseline * focal / (0.4 * width), baseline * 3.0 * focal
