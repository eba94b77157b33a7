"""Depth of what only one photograph shows, moved out of the space that others see through.

Surfaces continue into what is not measured, and may come to stand where other photographs see
farther. They are wrong there, and dropped. Where nothing else covers these pixels, the joint fit
would inflate what is beside them to a fog before the photograph (decision 137).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gscompleter.numerics.kernels import stereo
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.reconstructors.plane_sweep.fusion import DepthLayer
from gscompleter.reconstructors.plane_sweep.rig import Transform, Transforms
from gscompleter.reconstructors.plane_sweep.sweep import MAX_RETURN_ERROR, UNKNOWN, Map, Mask

STEP = np.float32(1.05)
"""Factor of the depth by which pixels are moved at a time."""
FARTHEST = np.float32(2)
"""Depth up to which pixels are moved, relative to the farthest one of their view."""
MARGIN = 0.25
"""Margin around the images of others, as a share of their sides, into which their surfaces go on.
The first place beside an image would be wrong before a camera that turns a little from there."""


@dataclass(frozen=True)
class Surfaces:
    """The surfaces that a view measured, continued beyond the border of its image."""

    inverse: Map
    """Inverse depth per widest baseline; `UNKNOWN` where nothing is measured."""
    left: int
    """Columns beyond the image on either side."""
    top: int
    """Rows beyond the image above and below."""

    @staticmethod
    def measured_in(layer: DepthLayer) -> Surfaces:
        """Take what a layer measured; beyond the border surfaces go on parallel to the image."""
        measured = np.where(layer.measured_mask, layer.inverse, UNKNOWN)
        height, width = measured.shape
        top = round(MARGIN * height)
        left = round(MARGIN * width)
        return Surfaces(np.pad(measured, ((top, top), (left, left)), mode="edge"), left, top)

    def transform_from(self, transform: Transform) -> Transform:
        """Let a transform to the pixels of the image lead to those of the continued map."""
        shifted = transform.copy()
        shifted[0] += self.left * transform[2]
        shifted[1] += self.top * transform[2]
        return shifted

    def transform_to(self, transform: Transform) -> Transform:
        """Let a transform from the pixels of the image begin at those of the continued map."""
        shifted = transform.copy()
        shifted[:, 2] -= self.left * transform[:, 0] + self.top * transform[:, 1]
        return shifted


def leave_free_space(
    layers: Sequence[DepthLayer], open_pixels: Sequence[Mask], transforms: Transforms
) -> list[DepthLayer]:
    """Move the `open_pixels` of each view that are not measured back, until none sees through them.

    They come to rest on or behind the surfaces of the other views, or beside these. Pixels without
    such a place stay, and so does a layer of which none moves.
    """
    surfaces = [Surfaces.measured_in(layer) for layer in layers]

    def move(number: int) -> DepthLayer:
        layer = layers[number]
        inverse = layer.inverse
        waiting = open_pixels[number] & ~layer.measured_mask
        lowest = inverse.min() / FARTHEST
        while waiting.any():
            waiting = waiting & find_seen_through(number, inverse, surfaces, transforms)
            inverse = np.where(waiting, inverse / STEP, inverse)
            is_too_far = waiting & (inverse < lowest)
            inverse = np.where(is_too_far, layer.inverse, inverse)
            waiting = waiting & ~is_too_far
        return layer if np.array_equal(inverse, layer.inverse) else replace(layer, inverse=inverse)

    return map_in_parallel(move, range(len(layers)))


def find_seen_through(
    number: int, inverse: Map, surfaces: Sequence[Surfaces], transforms: Transforms
) -> Mask:
    """Find the pixels of a view that stand before a surface of another view.

    Unlike `compare_with_views` it tolerates no distance before a surface, which would stand there
    twice.
    """
    seen_through = np.zeros(inverse.shape, bool)
    for other, surface in enumerate(surfaces):
        if other == number:
            continue
        there = surface.transform_from(transforms[number, other])
        back = surface.transform_to(transforms[other, number])
        # `ratio` is z as expected in the other view over z as measured there; near 0 it is unknown.
        error, ratio = stereo.reproject(inverse, surface.inverse, there, back)
        is_apart = (error > MAX_RETURN_ERROR) & (ratio > 1e-3)
        seen_through |= is_apart & (ratio < 1)
    return seen_through
