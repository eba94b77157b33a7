"""Depth of what only one photograph shows, moved out of the space that others see through.

Surfaces continue into what is not measured, and may come to stand where other photographs see
farther. They are wrong there, and dropped. Where nothing else covers these pixels, the joint fit
would inflate what is beside them to a fog before the photograph: they move back (decision 137).
Where something covers them that looks otherwise, as the facade and the sky behind a branch before
one of the cameras, they stand before it: they come nearer (decision 156).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from gscompleter.numerics.kernels import stereo
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.reconstructors.plane_sweep.fusion import DepthLayer
from gscompleter.reconstructors.plane_sweep.rig import Transform, Transforms
from gscompleter.reconstructors.plane_sweep.sweep import MAX_RETURN_ERROR, UNKNOWN, Map, Mask
from gscompleter.types import View

STEP = np.float32(1.05)
"""Factor of the depth by which pixels are moved at a time."""
FARTHEST = np.float32(2)
"""Depth up to which pixels are moved, relative to the farthest one of their view."""
NEAREST = np.float32(3)
"""Inverse depth up to which pixels are moved, relative to the nearest one of their view."""
MAX_COLOR_ERROR = 0.15
"""Error of a colour in [0, 1], averaged over a window, from which on something else is shown."""
WINDOW_SIDE = 9
"""Side of that window in pixels: edges beside their place are no occluders."""
MIN_OCCLUDER = 0.005
"""Least share of the image that an occluder has. What looks otherwise in small spots, such as a
reflection, would fly before the scene."""
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


def find_occluders(shown: Float[Tensor, "h w 3"], view: View) -> Mask:
    """Find what the photograph of a view shows before what the scene shows there.

    `shown` is the render of the scene. An occluder that no other camera saw, though they look at
    the place behind it, is near this camera and reaches out of its image.
    """
    error = (shown.clamp(0, 1) - view.image).cpu().numpy()
    smooth = cv2.blur(error, (WINDOW_SIDE, WINDOW_SIDE))
    is_other = (np.abs(smooth).mean(axis=-1) > MAX_COLOR_ERROR) & view.valid_mask.cpu().numpy()
    _, labels, stats, _ = cv2.connectedComponentsWithStats(is_other.astype(np.uint8))
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= MIN_OCCLUDER * is_other.size)
    at_border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    return is_other & np.isin(labels, np.intersect1d(large, at_border))


def leave_free_space(
    layers: Sequence[DepthLayer],
    open_pixels: Sequence[Mask],
    occluders: Sequence[Mask],
    transforms: Transforms,
) -> list[DepthLayer]:
    """Move pixels of each view that are not measured, until no other view sees through them.

    The `occluders` come nearer, until the others do not see them. The `open_pixels` move back, and
    come to rest on or behind the surfaces of the other views, or beside these. Pixels without such
    a place stay, and so does a layer of which none moves.
    """
    surfaces = [Surfaces.measured_in(layer) for layer in layers]

    def move(number: int) -> DepthLayer:
        layer = layers[number]
        sees_through = partial(find_seen_through, number, surfaces=surfaces, transforms=transforms)
        lowest = layer.inverse.min() / FARTHEST
        highest = layer.inverse.max() * NEAREST
        nearer = occluders[number] & ~layer.measured_mask
        inverse = move_pixels(layer.inverse, nearer, STEP, lowest, highest, sees_through)
        back = open_pixels[number] & ~layer.measured_mask & (inverse == layer.inverse)
        inverse = move_pixels(inverse, back, 1 / STEP, lowest, highest, sees_through)
        return layer if np.array_equal(inverse, layer.inverse) else replace(layer, inverse=inverse)

    return map_in_parallel(move, range(len(layers)))


def move_pixels(
    start: Map,
    waiting: Mask,
    factor: np.float32,
    lowest: np.float32,
    highest: np.float32,
    sees_through: Callable[[Map], Mask],
) -> Map:
    """Multiply inverse depths by a factor, while other views see through them.

    Pixels that reach the lowest or highest inverse depth go back to where they started.
    """
    inverse = start
    while waiting.any():
        waiting = waiting & sees_through(inverse)
        inverse = np.where(waiting, inverse * factor, inverse)
        is_lost = waiting & ((inverse < lowest) | (inverse > highest))
        inverse = np.where(is_lost, start, inverse)
        waiting = waiting & ~is_lost
    return inverse


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
