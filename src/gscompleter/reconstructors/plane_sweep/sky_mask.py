"""Detection of the sky from its surroundings.

Stereo cannot measure a uniform sky. A ceiling or blank wall is uniform too, but its outline lies on
one plane, not much farther than the rest. A sky therefore needs all of: no texture, no parallax, a
wide and high region connected to the top of the image that is brighter than its outline, and an
outline on no plane. Besides, something has to tell it from what is white indoors (decision 156):
a large part of the outline is far away, or any photograph shows a blue sky. Nothing stands far
behind a building. An undetected sky keeps the depth of its surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32

from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_contrast,
    take_largest_channel,
)
from gscompleter.reconstructors.plane_sweep.rig import Rig
from gscompleter.reconstructors.plane_sweep.sweep import Map, Mask, Measurement

MAX_SKY_GRADIENT = 0.012
"""Largest colour gradient inside a sky, per pixel, for colours in [0, 1]."""
MAX_SKY_DIFFERENCE = 0.06
"""Largest colour difference of an edge pixel to the sky beside it."""
EDGE_RADIUS = 3
"""Distance in pixels at which an edge still raises the gradient of the sky."""
SKY_OUTLINE_WIDTH = 3
"""Width of the outline of a sky, in pixels."""
MIN_LIGHT = 0.5
"""Least lightness of a part of the sky, relative to the median of all parts."""
MIN_SKY_WIDTH = 0.4
"""Smallest fraction of the top image row that a sky covers."""
MIN_HEIGHT = 0.1
"""Smallest mean height of a sky over its columns, as a fraction of the image height."""
MIN_UNBROKEN = 0.6
"""Smallest fraction of a sky that is directly connected to the top of the image."""
LOWEST = 0.55
"""Fraction of the image height, from the top, in which nearly all of a sky lies."""
MIN_ABOVE = 0.95
"""Smallest fraction of a sky that lies there."""
MIN_OUTLINE = 64
"""Fewest measured outline pixels for a decision."""
END_SHARE = 0.05
"""Fraction of the outline, the farthest, that must be close to infinity."""
END_PLANES = 3.0
"""Largest distance from infinity of that part, in planes of half a pixel of parallax."""
FAR_PLANE_MARGIN = 2.0
"""Alternative to `END_PLANES`: distance of that part from the far plane of the sweep, in planes."""
MAX_FAR_PLANE = 10.0
"""Largest distance from infinity of far plane and margin together for which that holds."""
FAR_SHARE = 0.2
"""Fraction of the outline, the farthest, that must be far away."""
FAR_RATIO = 2.5
"""Smallest depth of that part, in median depths of the measured scene."""
MAX_ON_PLANE = 0.8
"""Fraction of the outline on one plane from which the region is a ceiling or wall."""
NEAR_PLANES = 5.0
"""Distance from infinity, in planes, from which an outline pixel is near."""
MAX_NEAR_ON_PLANE = 0.9
"""The same limit for the near outline pixels alone."""
PLANE_TOLERANCE = 2.0
"""Largest distance of a pixel from a plane it lies on, in sweep planes."""
SKY_FIT_ITERATIONS = 20
"""Iterations of reweighted least squares."""
MIN_SKY_AGREEMENT = 0.5
"""Fraction of a sky that must also be sky in the other views."""
MIN_BLUE = 0.12
"""Least amount by which the median blue of a blue sky exceeds its red, for colours in [0, 1]."""
DEEP_BLUE = 0.3
"""The same amount from which on its outline may lie on one plane."""
MIN_BLUE_LIGHT = 0.6
"""Least median blue of such a sky. Walls in a shade of blue are darker."""


def find_skies(rig: Rig, measurements: Sequence[Measurement]) -> list[Mask]:
    """Find the sky of each view that the other views confirm."""
    pairs = list(zip(rig.images, measurements, strict=True))
    skies = [find_candidate(image, measured) for image, measured in pairs]
    # A sky that is clipped to white tells nothing by itself. Where any view shows a blue one, all
    # candidates are skies.
    if not any(is_blue(image, sky) for image, sky in zip(rig.images, skies, strict=True)):
        skies = [
            keep_distant(image, measured, sky)
            for (image, measured), sky in zip(pairs, skies, strict=True)
        ]
    return [
        sky if is_confirmed(number, sky, skies, rig) else np.zeros_like(sky)
        for number, sky in enumerate(skies)
    ]


def transfer_sky(rig: Rig, sky_of_second: Mask) -> Mask:
    """Find the sky of the first view of a pair in the directions of the second view's sky."""
    first = rig.images[0]
    return find_even_region(first) & (sample_at_infinity(first.size, sky_of_second, rig, 0, 1) == 1)


def find_sky(image: StereoImage, measured: Measurement) -> Mask:
    """Find the uniform region at the top of the image if it is a sky by itself."""
    region = find_candidate(image, measured)
    return region if is_blue(image, region) else keep_distant(image, measured, region)


def find_candidate(image: StereoImage, measured: Measurement) -> Mask:
    """Find the uniform region at the top of the image if its outline may be that of a sky."""
    region = find_even_region(image)
    nothing = np.zeros_like(region)
    if not is_overhead(region):
        return nothing
    heights, is_measured, _ = measure_heights(measured, image.size)
    outline = find_outline(region) & is_measured
    if outline.sum() < MIN_OUTLINE:
        return nothing
    if np.median(image.image[region]) <= np.median(image.image[outline]):
        return nothing
    # No ceiling is so blue, which may be above a flat roof as well.
    if is_blue(image, region, DEEP_BLUE):
        return region
    # The outline of a ceiling or wall lies on one plane; its near part is tested alone, too.
    near = outline & (heights > max(NEAR_PLANES, 2 * np.quantile(heights[outline], END_SHARE)))
    is_plane = (
        measure_planarity(outline, heights) >= MAX_ON_PLANE
        or measure_planarity(near, heights) >= MAX_NEAR_ON_PLANE
    )
    return nothing if is_plane else region


def is_blue(image: StereoImage, region: Mask, least: float = MIN_BLUE) -> bool:
    """Test if a region, which may be empty, has the colour of a blue sky.

    `least` is the least amount by which its median blue exceeds its red.
    """
    if not region.any():
        return False
    red, green, blue = np.median(image.image[region], axis=0)
    return bool(red <= green <= blue and blue >= MIN_BLUE_LIGHT and blue - red >= least)


def keep_distant(image: StereoImage, measured: Measurement, region: Mask) -> Mask:
    """Keep a region, which may be empty, if its outline is near infinity."""
    if not region.any():
        return region
    heights, is_measured, far_plane = measure_heights(measured, image.size)
    outline = find_outline(region) & is_measured
    is_far = is_distant(heights[outline], heights[is_measured & ~region], far_plane)
    return region if is_far else np.zeros_like(region)


def measure_heights(measured: Measurement, size: tuple[int, int]) -> tuple[Map, Mask, float]:
    """Measure inverse depths in planes of the sweep, from infinity on.

    Return them with the measured pixels and the height of the far plane.
    """
    full = measured.resize_to(size)
    # Indices count from the far plane.
    far_plane = full.planes[0] / (full.planes[1] - full.planes[0])
    return full.index + far_plane, full.confidence > 0, float(far_plane)


def find_outline(region: Mask) -> Mask:
    """Find the pixels beside a region."""
    return dilate_square(region, SKY_OUTLINE_WIDTH) & ~region


def is_overhead(region: Mask) -> bool:
    """Test if `region` covers a large part of the top of the image."""
    width = region[0].mean()
    area = region.mean()
    if width < MIN_SKY_WIDTH or area < MIN_HEIGHT * width:
        return False
    # Unbroken pixels have only pixels of the region above them in their column.
    unbroken = np.logical_and.accumulate(region, axis=0).sum() / region.sum()
    above = region[: round(LOWEST * len(region))].sum() / region.sum()
    return bool(unbroken >= MIN_UNBROKEN and above >= MIN_ABOVE)


def find_even_region(image: StereoImage) -> Mask:
    """Find the uniform region connected to the top of the image, up to its edges."""
    smooth = compute_color_gradient(image) < MAX_SKY_GRADIENT
    # Erosion cuts narrow bridges between the sky and an even surface.
    even = cv2.erode(smooth.astype(np.uint8), np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(even, connectivity=4)
    core = np.isin(labels, labels[0][labels[0] > 0])
    if core.any():
        # What is dark is even, too, as a tree against the light.
        light = image.image.max(axis=-1)
        usual = np.median(light[core])
        parts = np.unique(labels[core])
        core &= np.isin(
            labels, [n for n in parts if np.median(light[labels == n]) >= MIN_LIGHT * usual]
        )
    # An edge raises the gradient around it, so that the core ends before the sky does. Pixels
    # beside it that have its colour are added.
    alike = compute_difference_from_core(core, image) < MAX_SKY_DIFFERENCE
    return core | (dilate_square(core, EDGE_RADIUS) & alike)


def compute_color_gradient(image: StereoImage) -> Map:
    """Compute the largest colour gradient of each pixel."""
    smooth = cv2.GaussianBlur(image.image.astype(np.float32), (0, 0), 1.0)
    # Weights of the filter sum to 8 on either side; the scale makes it a difference per pixel.
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    return take_largest_channel(cv2.magnitude(across, down))


def compute_difference_from_core(core: Mask, image: StereoImage) -> Map:
    """Compute the largest channel difference to the mean colour of `core` nearby."""
    colour = image.image.astype(np.float32)
    weight = core.astype(np.float32)
    size = (4 * EDGE_RADIUS + 1, 4 * EDGE_RADIUS + 1)
    total = cv2.boxFilter(weight, -1, size)
    mean = cv2.boxFilter(colour * weight[..., None], -1, size) / np.maximum(total, 1e-6)[..., None]
    return compute_contrast(colour, mean)


def is_distant(
    outline: Float32[np.ndarray, "n"], measured: Float32[np.ndarray, "m"], far_plane: float
) -> bool:
    """Test if an outline is near infinity and far behind the scene (planes from infinity)."""
    end, far = np.quantile(outline, [END_SHARE, FAR_SHARE])
    is_far = end <= END_PLANES or (end <= far_plane + FAR_PLANE_MARGIN <= MAX_FAR_PLANE)
    return bool(is_far and far * FAR_RATIO <= np.median(measured))


def measure_planarity(outline: Mask, heights: Map) -> float:
    """Compute the fraction of an outline on its best plane; 0 if there are too few pixels."""
    if outline.sum() < MIN_OUTLINE:
        return 0.0
    rows, columns = np.nonzero(outline)
    sites = np.stack([columns, rows, np.ones_like(rows)], axis=1).astype(np.float64)
    values = heights[outline].astype(np.float64)
    weight = np.ones(len(rows))
    # Weights 1 / |deviation| make least squares minimize the sum of deviations, which outliers do
    # not dominate.
    for _ in range(SKY_FIT_ITERATIONS):
        weighted = sites * weight[:, None]
        plane = np.linalg.lstsq(weighted.T @ sites, weighted.T @ values, rcond=None)[0]
        weight = 1 / np.maximum(np.abs(sites @ plane - values), 0.1 * PLANE_TOLERANCE)
    return float((np.abs(sites @ plane - values) < PLANE_TOLERANCE).mean())


def is_confirmed(number: int, sky: Mask, others: Sequence[Mask], rig: Rig) -> bool:
    """Test if most of `sky` is sky in another view, as far as others show its directions.

    Where several show a direction one is enough: a tree may stand before the sky in the others.
    """
    answers = [
        sample_at_infinity(sky.shape, other, rig, number, i)[sky]
        for i, other in enumerate(others)
        if i != number
    ]
    if not answers:
        return True
    best = np.max(answers, axis=0)
    is_shown = best >= 0
    return bool(is_shown.any()) and float(best[is_shown].mean()) > MIN_SKY_AGREEMENT


def sample_at_infinity(
    size: tuple[int, ...], mask: Mask, rig: Rig, this: int, other: int
) -> Float32[np.ndarray, "h w"]:
    """Sample the mask of another view in each pixel's direction; -1 if outside."""
    x = np.arange(size[1]) + 0.5
    y = np.arange(size[0])[:, None] + 0.5
    # At inverse depth 0 only the homography of the transform counts.
    homography = rig.transforms[this, other][:, :3]
    u, v, w = [a * x + b * y + c for a, b, c in homography]
    ahead = np.maximum(w, 1e-6)
    column = np.floor(u / ahead)
    row = np.floor(v / ahead)
    height, width = mask.shape
    seen = (w > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    sampled = mask[row.clip(0, height - 1).astype(int), column.clip(0, width - 1).astype(int)]
    return np.where(seen, sampled, -1).astype(np.float32)


def dilate_square(mask: Mask, radius: int) -> Mask:
    """Dilate `mask` by a square of `radius` pixels."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
