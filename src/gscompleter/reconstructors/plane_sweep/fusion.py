"""Fusion of many depth maps: each surface once, and nothing in observed free space."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from gscompleter.kernels import stereo
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.confidence import MAX_RETURN_ERROR, Map, Mask
from gscompleter.reconstructors.plane_sweep.occlusion import UNKNOWN

MAX_DEPTH_DIFFERENCE = 0.05
"""Largest relative depth difference between two views of the same surface."""
FINER_FOOTPRINT = 0.9
"""Footprint ratio below which another view is finer; otherwise the first view is kept."""


Transforms = Mapping[tuple[int, int], Float32[np.ndarray, "3 4"]]
"""`transforms[i, j]` is j_from_i: pixels of view i with inverse depth -> pixels of view j."""


@dataclass(frozen=True)
class Layer:
    """The inverse depth of one view."""

    image: StereoImage
    inverse: Map
    """Inverse depth of every pixel, per widest baseline."""
    confidence: Map
    """Confidence in [0, 1]; 0 for interpolated depths."""

    @property
    def measured_mask(self) -> Mask:
        """True at pixels with a measured depth."""
        return self.confidence > 0


def find_free_pixels(layers: Sequence[Layer], transforms: Transforms) -> list[Mask]:
    """Find the pixels of each view that are outside the free space of all other views."""
    everywhere = [np.ones_like(layer.measured_mask) for layer in layers]
    return [
        find_unrefuted(layer, compare_with_views(number, layers, everywhere, transforms))
        for number, layer in enumerate(layers)
    ]


def find_finest_pixels(
    layers: Sequence[Layer], free: Sequence[Mask], transforms: Transforms
) -> list[Mask]:
    """Find the `free` pixels of each view that no other view resolves better."""
    return [
        free[number]
        & ~find_better_elsewhere(
            number, layers, compare_with_views(number, layers, free, transforms), transforms
        )
        for number in range(len(layers))
    ]


@dataclass(frozen=True)
class DepthComparison:
    """Pixels of one view compared with the measured depths of another view."""

    other: int
    free_space_mask: Mask
    """True if the other view sees a surface behind the pixel."""
    same_surface_mask: Mask
    """True if the other view measured the same surface."""


def compare_with_views(
    number: int, layers: Sequence[Layer], kept: Sequence[Mask], transforms: Transforms
) -> Iterator[DepthComparison]:
    """Compare view `number` with the measured and `kept` pixels of each other view."""
    inverse = layers[number].inverse
    for other, layer in enumerate(layers):
        if other == number:
            continue
        there, back = transforms[number, other], transforms[other, number]
        sure = np.where(layer.measured_mask & kept[other], layer.inverse, UNKNOWN)
        error, ratio = stereo.reproject(inverse, sure, there, back)
        known = (error >= 0) & (ratio > 1e-3)
        apart = error > MAX_RETURN_ERROR
        through = known & apart & (ratio < 1 - MAX_DEPTH_DIFFERENCE)
        yield DepthComparison(
            other, through, known & ~apart & (np.abs(ratio - 1) < MAX_DEPTH_DIFFERENCE)
        )


def find_unrefuted(layer: Layer, comparisons: Iterator[DepthComparison]) -> Mask:
    """Mark pixels that no view sees through, or that more views confirm than refute."""
    balance = np.zeros(layer.inverse.shape, np.int32)
    seen_through = np.zeros(layer.inverse.shape, bool)
    for meeting in comparisons:
        balance += meeting.same_surface_mask.astype(np.int32) - meeting.free_space_mask
        seen_through |= meeting.free_space_mask
    return ~seen_through | (layer.measured_mask & (balance > 0))


def find_better_elsewhere(
    number: int,
    layers: Sequence[Layer],
    comparisons: Iterator[DepthComparison],
    transforms: Transforms,
) -> Mask:
    """Mark interpolated or coarse pixels whose surface another view measured better."""
    layer = layers[number]
    own = 1 / layer.inverse / layer.image.K[0, 0]
    better = np.zeros(own.shape, bool)
    for meeting in comparisons:
        ratio = compute_depth_ratio(layer.inverse, transforms[number, meeting.other])
        footprint = ratio / layer.inverse / layers[meeting.other].image.K[0, 0]
        limit = own / FINER_FOOTPRINT if meeting.other < number else own * FINER_FOOTPRINT
        better |= meeting.same_surface_mask & (~layer.measured_mask | (footprint < limit))
    return better


def compute_depth_ratio(
    inverse: Map, transform: Float32[np.ndarray, "3 4"]
) -> Float[np.ndarray, "h w"]:
    """Compute the z-depth of each surface in another view over that in its own view."""
    h, w = inverse.shape
    x, y = np.arange(w) + 0.5, np.arange(h)[:, None] + 0.5
    a, b, c, d = transform[2]
    return a * x + b * y + c + d * inverse
