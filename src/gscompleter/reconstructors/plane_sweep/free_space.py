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

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from gscompleter.numerics.image_ops import label_regions
from gscompleter.numerics.kernels import stereo
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.reconstructors.plane_sweep.fusion import DepthLayer
from gscompleter.reconstructors.plane_sweep.passages import Passages
from gscompleter.reconstructors.plane_sweep.rig import Transform, Transforms
from gscompleter.reconstructors.plane_sweep.sweep import MAX_RETURN_ERROR, UNKNOWN, Map, Mask
from gscompleter.types import View

STEP = np.float32(1.05)
"""Factor of the depth by which pixels are moved at a time."""
FARTHEST = np.float32(2)
"""Depth up to which pixels are moved, relative to the farthest one of their view."""
NEAREST_OCCLUDER = np.float32(3)
"""Inverse depth up to which occluders come nearer, relative to the nearest pixel of their view."""
MAX_COLOR_ERROR = 0.15
"""Error of a colour in [0, 1], averaged over a window, from which on something else is shown."""
WINDOW_SIDE = 9
"""Side of that window in pixels: edges beside their place are no occluders."""
MIN_OCCLUDER = 0.005
"""Least share of the image that an occluder has. What looks otherwise in small spots, such as a
reflection, would fly before the scene."""
MIN_WITHOUT_PLACE = 0.3
"""Least share of an occluder that has no place behind. What looks otherwise because the scene is
wrong there has one: before the target of a fountain it cost 6 dB."""
MARGIN = 0.25
"""Margin around the images of others, as a share of their sides, into which their surfaces go on.
The first place beside an image would be wrong before a camera that turns a little from there."""

Labels = Int[np.ndarray, "h w"]
"""Number of the occluder that each pixel shows; 0 where it shows none."""


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


def find_occluders(shown: Float[Tensor, "h w 3"], view: View) -> Labels:
    """Find what the photograph of a view may show before what the scene shows there.

    Return the number of the occluder of each pixel, 0 where there is none. `shown` is the render of
    the scene. An occluder that no other camera saw, though they look at the place behind it, is
    near this camera and reaches out of its image.
    """
    error = (shown.clamp(0, 1) - view.image).cpu().numpy()
    smooth = cv2.blur(error, (WINDOW_SIDE, WINDOW_SIDE))
    is_other = torch.from_numpy(np.abs(smooth).mean(axis=-1) > MAX_COLOR_ERROR)
    labels = label_regions(is_other & view.valid_mask.cpu())[0].numpy()
    large = np.flatnonzero(np.bincount(labels.ravel()) >= MIN_OCCLUDER * labels.size)
    at_border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    return np.where(np.isin(labels, np.intersect1d(large, at_border)), labels, 0)


def leave_free_space(
    layers: Sequence[DepthLayer],
    open_pixels: Sequence[Mask],
    occluders: Sequence[Labels],
    skies: Sequence[Mask],
    transforms: Transforms,
    passages: Passages = Passages(),
) -> list[DepthLayer]:
    """Move pixels of each view that are not measured, until no other view sees through them.

    Nor do they block `passages` then. The `open_pixels` move back, and come to rest on or behind
    the surfaces of the other views, or beside these. `occluders` that have no such place, as where
    the others see the sky, come nearer until the others do not see them. Pixels without a place
    stay, and so does a layer of which none moves. `skies` mark the sky of each view.
    """
    surfaces = [Surfaces.measured_in(layer) for layer in layers]

    def move(number: int) -> DepthLayer:
        layer = layers[number]
        start = layer.inverse

        def find_before(inverse: Map, mask: Mask) -> Mask:
            seen_through = find_seen_through(number, inverse, mask, surfaces, transforms)
            return seen_through | passages.find_blocking(number, inverse, mask & ~seen_through)

        of_surfaces = start[~skies[number]]
        if not len(of_surfaces):
            return layer
        lowest = of_surfaces.min() / FARTHEST
        highest = of_surfaces.max() * NEAREST_OCCLUDER
        labels = np.where(layer.measured_mask, 0, occluders[number])
        waiting = (open_pixels[number] & ~layer.measured_mask) | (labels > 0)
        back = move_pixels(start, waiting, 1 / STEP, lowest, highest, find_before)
        # A part of it may have a place on a surface behind it, of another colour.
        has_no_place = find_before(start, (labels > 0) & (back == start))
        nearer = find_components(labels, has_no_place, MIN_WITHOUT_PLACE)
        inverse = move_pixels(start, nearer, STEP, lowest, highest, find_before)
        inverse = np.where(open_pixels[number] & (inverse == start), back, inverse)
        return layer if np.array_equal(inverse, start) else replace(layer, inverse=inverse)

    return map_in_parallel(move, range(len(layers)))


def find_components(labels: Labels, mask: Mask, least: float) -> Mask:
    """Find the components, 0 is none, of which `mask` covers at least a share."""
    counts = np.bincount(labels.ravel())
    covered = np.bincount(labels.ravel(), mask.ravel(), len(counts))
    is_chosen = covered >= least * counts
    is_chosen[0] = False
    return is_chosen[labels]


def move_pixels(
    start: Map,
    waiting: Mask,
    factor: np.float32,
    lowest: np.float32,
    highest: np.float32,
    find_before: Callable[[Map, Mask], Mask],
) -> Map:
    """Multiply inverse depths by a factor, while other views see through them.

    `find_before` finds the pixels in a mask that stand before what others see. Pixels that reach
    the lowest or highest inverse depth go back to where they started.
    """
    inverse = start
    while waiting.any():
        waiting = find_before(inverse, waiting)
        inverse = np.where(waiting, inverse * factor, inverse)
        is_lost = waiting & ((inverse < lowest) | (inverse > highest))
        inverse = np.where(is_lost, start, inverse)
        waiting = waiting & ~is_lost
    return inverse


def find_seen_through(
    number: int, inverse: Map, mask: Mask, surfaces: Sequence[Surfaces], transforms: Transforms
) -> Mask:
    """Find the pixels in the mask of a view that stand before a surface of another view.

    Unlike `compare_with_views` it tolerates no distance before a surface, which would stand there
    twice.
    """
    rows, columns = np.nonzero(mask)
    for other, surface in enumerate(surfaces):
        if other == number:
            continue
        there = surface.transform_from(transforms[number, other])
        back = surface.transform_to(transforms[other, number])
        # `ratio` is z as expected in the other view over z as measured there; near 0 it is unknown.
        error, ratio = stereo.reproject_pixels(rows, columns, inverse, surface.inverse, there, back)
        is_before = (error > MAX_RETURN_ERROR) & (ratio > 1e-3) & (ratio < 1)
        # One other view is enough.
        rows, columns = rows[~is_before], columns[~is_before]
    seen_through = mask.copy()
    seen_through[rows, columns] = False
    return seen_through
