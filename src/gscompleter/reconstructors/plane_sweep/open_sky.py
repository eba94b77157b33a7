"""Which pixels of a photograph show the sky, told by what lies around it.

Stereo knows nothing of a sky: it is even, so that any depth matches, and aggregation lends it that
of roofs and trees. A ceiling or a blank wall is even, too, but bounded by a room: what surrounds it
lies on the plane that it is, and not much farther than the rest of the room. So a sky needs all of:
no texture and no parallax, a wide and high region in the upper half of the image that nothing cuts
off from its top, and an outline of which a good part is far away. A sky that lacks one of them is
not found, and stays at the depth of what surrounds it.
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
"""Of an image that may have another size."""
Plane = Float64[np.ndarray, "3"]

EVEN = 0.012
"""Largest slope of colour per pixel, in images of [0, 1], within a sky."""
LIKE = 0.06
"""Difference of colour to the sky beside it up to which a pixel at its edge is sky, too."""
EDGE = 3
"""Pixels by which edges blur the slope of the sky beside them."""
OUTLINE = 3
"""Width in pixels of what counts as the outline of a sky."""
MIN_WIDTH = 0.4
"""Smallest share of the image's top row that a sky fills."""
MIN_HEIGHT = 0.1
"""Smallest mean height of a sky, over the columns in which it reaches the top, as a share of the
image's height."""
MIN_UNBROKEN = 0.6
"""Smallest share of a sky with nothing between it and the top of the image."""
LOWEST, MOST = 0.55, 0.95
"""Share of the image's height, from the top, above which at least this share of a sky lies."""
MIN_OUTLINE = 64
"""Fewest measured pixels of an outline that can tell a sky."""
END_SHARE = 0.05
"""Share of the outline, the farthest, that has to come close to infinity."""
END_PLANES = 3.0
"""Planes from infinity within which it has to come: half a pixel of parallax each."""
FAR_PLANE_MARGIN, MAX_FAR_PLANE = 2.0, 10.0
"""Or planes from the far plane, where that itself lies no more planes than this from infinity."""
FAR_SHARE = 0.2
"""Share of the outline, the farthest, that has to be far away."""
FAR_RATIO = 2.5
"""Depth of that part of the outline, in medians of what is measured below the sky, at least."""
MAX_ON_PLANE = 0.8
"""Share of the outline on one plane from which the region is that plane: a ceiling or a wall."""
NEAR_PLANES, MAX_NEAR_ON_PLANE = 5.0, 0.9
"""The same for that part of the outline which is more planes than this from infinity, where all
planes meet, and twice as many as its far end."""
PLANE_TOLERANCE = 2.0
"""Planes of the sweep by which a pixel may miss a plane that it lies on."""
ROUNDS = 20
"""Of reweighted least squares."""
AGREEMENT = 0.5
"""Share of a sky that must be sky in the other views, too, as far as they look there."""


def skies(rig: Rig, found: Sequence[Measured]) -> list[Mask]:
    """Where each view shows the sky; every view must agree with those that look the same way."""
    own = [sky_above(image, f) for image, f in zip(rig.images, found, strict=True)]
    return [
        sky if confirmed(number, sky, own, rig) else np.zeros_like(sky)
        for number, sky in enumerate(own)
    ]


def sky_shown(rig: Rig, sky_of_second: OtherMask) -> Mask:
    """The sky in the first view of a pair, as far as the second shows it in the same direction."""
    first = rig.images[0]
    return even_above(first) & (at_infinity(first.size, sky_of_second, rig, 0, 1) == 1)


def without(found: Measured, where: Mask) -> Measured:
    """Leave out what was measured `where` it does not count, as in the sky."""
    full = found.at_size(where.shape)
    weight, confidence = (
        np.where(where, np.float32(0), share) for share in (full.weight, full.confidence)
    )
    return replace(full, weight=weight, confidence=confidence)


def sky_above(image: StereoImage, found: Measured) -> Mask:
    """The even region from the top of the image, where what surrounds it tells that it is open."""
    region = even_above(image)
    return region if is_open(image, found, region) else np.zeros_like(region)


def is_open(image: StereoImage, found: Measured, region: Mask) -> bool:
    """Whether what surrounds `region` tells that nothing is behind it."""
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
    """Tell whether `region` fills a good part of the top of the image, as a sky does."""
    width, area = region[0].mean(), region.mean()
    if width < MIN_WIDTH or area < MIN_HEIGHT * width:
        return False
    unbroken = np.logical_and.accumulate(region, axis=0).sum() / region.sum()
    above = region[: round(LOWEST * len(region))].sum() / region.sum()
    return bool(unbroken >= MIN_UNBROKEN and above >= MOST)


def even_above(image: StereoImage) -> Mask:
    """What is even and connected to the top of the image, up to the edges around it."""
    even = cv2.erode((slope_of(image) < EVEN).astype(np.uint8), np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(even, connectivity=4)
    top = labels[0][labels[0] > 0]
    core = np.isin(labels, top)
    return core | (dilated(core, EDGE) & (difference_from(core, image) < LIKE))


def slope_of(image: StereoImage) -> Map:
    """The steepest change of a colour, per pixel."""
    smooth = cv2.GaussianBlur(image.image.astype(np.float32), (0, 0), 1.0)
    across, down = (
        cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1))
    )
    return largest(cv2.magnitude(across, down))


def difference_from(core: Mask, image: StereoImage) -> Map:
    """How far each pixel is from the mean colour of `core` around it, in its worst channel."""
    colour, weight = image.image.astype(np.float32), core.astype(np.float32)
    size = (4 * EDGE + 1, 4 * EDGE + 1)
    total = cv2.boxFilter(weight, -1, size)
    mean = cv2.boxFilter(colour * weight[..., None], -1, size) / np.maximum(total, 1e-6)[..., None]
    return contrast(colour, mean)


def reaches_far(
    outline: Float32[np.ndarray, "n"], measured: Float32[np.ndarray, "m"], far_plane: float
) -> bool:
    """Tell whether an outline comes close to infinity, and far beyond most of what is measured.

    Args:
        outline: Inverse depths, in planes from infinity.
        measured: The same of all pixels that were measured and may not be sky.
        far_plane: The same of the far plane, beyond which nothing is measured.
    """
    end, far = np.quantile(outline, [END_SHARE, FAR_SHARE])
    is_far = end <= END_PLANES or (end <= far_plane + FAR_PLANE_MARGIN <= MAX_FAR_PLANE)
    return bool(is_far and far * FAR_RATIO <= np.median(measured))


def on_one_plane(outline: Mask, heights: Map) -> float:
    """Share of the outline that lies on the plane that fits it best, by absolute differences; 0 of
    fewer than `MIN_OUTLINE` pixels."""
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
    """Whether most of `sky` is that of the views that look there, too."""
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
    """What `mask` of view `other` says in the direction of each pixel of view `this`: 1 or 0, and
    -1 where it does not look."""
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
    """`mask` grown by `radius` pixels on every side."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
