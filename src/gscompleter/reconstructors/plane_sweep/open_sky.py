"""Detection of the sky from its surroundings.

Stereo cannot measure a uniform sky. A ceiling or blank wall is uniform too, but its outline lies on
one plane, not much farther than the rest. A sky therefore needs all of: no texture, no parallax, a
wide and high region connected to the top of the image, and an outline of which a large part is far
away. An undetected sky keeps the depth of its surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from gscompleter.matching.stereo_image import StereoImage, contrast, largest
from gscompleter.reconstructors.plane_sweep.measuring import Measured
from gscompleter.reconstructors.plane_sweep.rig import Rig

Map = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
OtherMask = Bool[np.ndarray, "a b"]
Plane = Float64[np.ndarray, "3"]

EVEN = 0.012
"""Largest colour gradient inside a sky, per pixel, for colours in [0, 1]."""
LIKE = 0.06
"""Largest colour difference of an edge pixel to the sky beside it."""
EDGE = 3
"""Distance in pixels at which an edge still raises the gradient of the sky."""
OUTLINE = 3
"""Width of the outline of a sky, in pixels."""
MIN_WIDTH = 0.4
"""Smallest fraction of the top image row that a sky covers."""
MIN_HEIGHT = 0.1
"""Smallest mean height of a sky over its columns, as a fraction of the image height."""
MIN_UNBROKEN = 0.6
"""Smallest fraction of a sky that is directly connected to the top of the image."""
LOWEST, MOST = 0.55, 0.95
"""Image height fraction, and the smallest fraction of a sky that lies above it."""
MIN_OUTLINE = 64
"""Fewest measured outline pixels for a decision."""
END_SHARE = 0.05
"""Fraction of the outline, the farthest, that must be close to infinity."""
END_PLANES = 3.0
"""Largest distance from infinity of that part, in planes of half a pixel of parallax."""
FAR_PLANE_MARGIN, MAX_FAR_PLANE = 2.0, 10.0
"""Alternative limit in planes beyond the far plane, and the largest sum that is far."""
FAR_SHARE = 0.2
"""Fraction of the outline, the farthest, that must be far away."""
FAR_RATIO = 2.5
"""Smallest depth of that part, in median depths of the measured scene."""
MAX_ON_PLANE = 0.8
"""Fraction of the outline on one plane from which the region is a ceiling or wall."""
NEAR_PLANES, MAX_NEAR_ON_PLANE = 5.0, 0.9
"""Planes from infinity of near outline pixels, and the same limit for these alone."""
PLANE_TOLERANCE = 2.0
"""Largest distance of a pixel from a plane it lies on, in sweep planes."""
ROUNDS = 20
"""Iterations of reweighted least squares."""
AGREEMENT = 0.5
"""Fraction of a sky that must also be sky in the other views."""


def skies(rig: Rig, found: Sequence[Measured]) -> list[Mask]:
    """Find the sky of each view that the other views confirm."""
    own = [sky_above(image, f) for image, f in zip(rig.images, found, strict=True)]
    return [
        sky if confirmed(number, sky, own, rig) else np.zeros_like(sky)
        for number, sky in enumerate(own)
    ]


def sky_shown(rig: Rig, sky_of_second: OtherMask) -> Mask:
    """Find the sky of the first view of a pair in the directions of the second view's sky."""
    first = rig.images[0]
    return even_above(first) & (at_infinity(first.size, sky_of_second, rig, 0, 1) == 1)


def without(found: Measured, where: Mask) -> Measured:
    """Set the weight and confidence to 0 at the pixels of a mask, such as the sky."""
    full = found.at_size(where.shape)
    weight, confidence = (
        np.where(where, np.float32(0), share) for share in (full.weight, full.confidence)
    )
    return replace(full, weight=weight, confidence=confidence)


def sky_above(image: StereoImage, found: Measured) -> Mask:
    """Find the uniform region at the top of the image if its outline is that of a sky."""
    region = even_above(image)
    return region if is_open(image, found, region) else np.zeros_like(region)


def is_open(image: StereoImage, found: Measured, region: Mask) -> bool:
    """Test the outline of `region` for an open sky."""
    full = found.at_size(image.size)
    measured = full.confidence > 0
    outline = dilated(region, OUTLINE) & ~region & measured
    if not is_overhead(region) or outline.sum() < MIN_OUTLINE:
        return False
    heights = full.index + full.planes[0] / (full.planes[1] - full.planes[0])
    bright = bool(np.median(image.image[region]) > np.median(image.image[outline]))
    far_plane = float(heights.min() - full.index.min())
    if not bright or not reaches_far(heights[outline], heights[measured & ~region], far_plane):
        return False
    near = outline & (heights > max(NEAR_PLANES, 2 * np.quantile(heights[outline], END_SHARE)))
    return (
        on_one_plane(outline, heights) < MAX_ON_PLANE
        and on_one_plane(near, heights) < MAX_NEAR_ON_PLANE
    )


def is_overhead(region: Mask) -> bool:
    """Test if `region` covers a large part of the top of the image."""
    width, area = region[0].mean(), region.mean()
    if width < MIN_WIDTH or area < MIN_HEIGHT * width:
        return False
    unbroken = np.logical_and.accumulate(region, axis=0).sum() / region.sum()
    above = region[: round(LOWEST * len(region))].sum() / region.sum()
    return bool(unbroken >= MIN_UNBROKEN and above >= MOST)


def even_above(image: StereoImage) -> Mask:
    """Find the uniform region connected to the top of the image, up to its edges."""
    even = cv2.erode((slope_of(image) < EVEN).astype(np.uint8), np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(even, connectivity=4)
    top = labels[0][labels[0] > 0]
    core = np.isin(labels, top)
    return core | (dilated(core, EDGE) & (difference_from(core, image) < LIKE))


def slope_of(image: StereoImage) -> Map:
    """Compute the largest colour gradient of each pixel."""
    smooth = cv2.GaussianBlur(image.image.astype(np.float32), (0, 0), 1.0)
    across, down = (
        cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1))
    )
    return largest(cv2.magnitude(across, down))


def difference_from(core: Mask, image: StereoImage) -> Map:
    """Compute the largest channel difference to the mean colour of `core` nearby."""
    colour, weight = image.image.astype(np.float32), core.astype(np.float32)
    size = (4 * EDGE + 1, 4 * EDGE + 1)
    total = cv2.boxFilter(weight, -1, size)
    mean = cv2.boxFilter(colour * weight[..., None], -1, size) / np.maximum(total, 1e-6)[..., None]
    return contrast(colour, mean)


def reaches_far(
    outline: Float32[np.ndarray, "n"], measured: Float32[np.ndarray, "m"], far_plane: float
) -> bool:
    """Test if an outline is near infinity and far behind the scene (planes from infinity)."""
    end, far = np.quantile(outline, [END_SHARE, FAR_SHARE])
    is_far = end <= END_PLANES or (end <= far_plane + FAR_PLANE_MARGIN <= MAX_FAR_PLANE)
    return bool(is_far and far * FAR_RATIO <= np.median(measured))


def on_one_plane(outline: Mask, heights: Map) -> float:
    """Compute the fraction of an outline on its best plane; 0 if there are too few pixels."""
    if outline.sum() < MIN_OUTLINE:
        return 0.0
    rows, columns = np.nonzero(outline)
    sites = np.stack([columns, rows, np.ones_like(rows)], axis=1).astype(np.float64)
    values, weight = heights[outline].astype(np.float64), np.ones(len(rows))
    for _ in range(ROUNDS):
        weighted = sites * weight[:, None]
        plane: Plane = np.linalg.lstsq(weighted.T @ sites, weighted.T @ values, rcond=None)[0]
        weight = 1 / np.maximum(np.abs(sites @ plane - values), 0.1 * PLANE_TOLERANCE)
    return float((np.abs(sites @ plane - values) < PLANE_TOLERANCE).mean())


def confirmed(number: int, sky: Mask, others: Sequence[np.ndarray], rig: Rig) -> bool:
    """Test if most of `sky` is sky in the other views that show its direction."""
    shown = [
        at_infinity(sky.shape, other, rig, number, i)[sky]
        for i, other in enumerate(others)
        if i != number
    ]
    answers = np.concatenate(shown) if shown else np.zeros(0)
    seen = answers >= 0
    return bool(seen.any()) and float(answers[seen].mean()) > AGREEMENT


def at_infinity(
    size: tuple[int, ...], mask: OtherMask, rig: Rig, this: int, other: int
) -> Float32[np.ndarray, "h w"]:
    """Sample the mask of another view in each pixel's direction; -1 if outside."""
    x, y = np.arange(size[1]) + 0.5, np.arange(size[0])[:, None] + 0.5
    turn = rig.transforms[this, other][:, :3]
    u, v, w = (a * x + b * y + c for a, b, c in turn)
    ahead = np.maximum(w, 1e-6)
    column, row = np.floor(u / ahead), np.floor(v / ahead)
    h, wide = mask.shape
    seen = (w > 1e-6) & (column >= 0) & (column < wide) & (row >= 0) & (row < h)
    at = row.clip(0, h - 1).astype(int), column.clip(0, wide - 1).astype(int)
    return np.where(seen, mask[at], -1).astype(np.float32)


def dilated(mask: Mask, radius: int) -> Mask:
    """Dilate `mask` by a square of `radius` pixels."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
