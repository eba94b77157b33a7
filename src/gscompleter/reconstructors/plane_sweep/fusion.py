"""Each surface once, by the view that sees it best, and nothing where another view sees through.

Every view tells a depth for all of its pixels, some of them measured, the others filled in. Of many
views most surfaces come several times, never quite in one place, and what one view fills in stands
before what another one measures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from gscompleter.kernels import stereo
from gscompleter.matching.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.confidence import MAX_RETURN_ERROR, Map, Mask
from gscompleter.reconstructors.plane_sweep.occlusion import UNKNOWN

SAME_DEPTH = 0.05
"""Share of its depth by which a surface may miss another view's and still be the same."""
FINER = 0.9
"""Share of a pixel's own footprint below which another view's is finer. Of those about as fine the
view that comes first keeps the surface."""


Transforms = Mapping[tuple[int, int], Float32[np.ndarray, "3 4"]]
"""`transforms[i, j]` is j_from_i: from the pixels of view i, at an inverse depth, to those of j."""


@dataclass(frozen=True)
class Layer:
    """What stereo says of one view."""

    image: StereoImage
    inverse: Map
    """Inverse depths of all pixels, per widest baseline."""
    confidence: Map
    """In [0, 1]: how sure it is of them; 0 where they were filled in."""

    @property
    def measured(self) -> Mask:
        """Where the depth was measured."""
        return self.confidence > 0


def free_pixels(layers: Sequence[Layer], transforms: Transforms) -> list[Mask]:
    """Which pixels of each view lie where no other view sees through them."""
    everywhere = [np.ones_like(layer.measured) for layer in layers]
    return [
        in_free_space(layer, meetings(number, layers, everywhere, transforms))
        for number, layer in enumerate(layers)
    ]


def finest_pixels(
    layers: Sequence[Layer], free: Sequence[Mask], transforms: Transforms
) -> list[Mask]:
    """Which of the `free` pixels of each view show what no other view shows better."""
    return [
        free[number]
        & ~better_elsewhere(number, layers, meetings(number, layers, free, transforms), transforms)
        for number in range(len(layers))
    ]


@dataclass(frozen=True)
class Meeting:
    """How the pixels of a view lie to what another view measured."""

    other: int
    through: Mask
    """The other one sees through them, to a surface behind."""
    same: Mask
    """The other one measured the same surface."""


def meetings(
    number: int, layers: Sequence[Layer], kept: Sequence[Mask], transforms: Transforms
) -> Iterator[Meeting]:
    """The pixels of view `number` beside each other view, as far as that is `kept`."""
    inverse = layers[number].inverse
    for other, layer in enumerate(layers):
        if other == number:
            continue
        there, back = transforms[number, other], transforms[other, number]
        sure = np.where(layer.measured & kept[other], layer.inverse, UNKNOWN)
        error, ratio = stereo.reproject(inverse, sure, there, back)
        known = (error >= 0) & (ratio > 1e-3)
        apart = error > MAX_RETURN_ERROR
        through = known & apart & (ratio < 1 - SAME_DEPTH)
        yield Meeting(other, through, known & ~apart & (np.abs(ratio - 1) < SAME_DEPTH))


def in_free_space(layer: Layer, met: Iterator[Meeting]) -> Mask:
    """Which pixels may stay: those that no view sees through, and measured ones that more views
    confirm."""
    balance = np.zeros(layer.inverse.shape, np.int32)
    seen_through = np.zeros(layer.inverse.shape, bool)
    for meeting in met:
        balance += meeting.same.astype(np.int32) - meeting.through
        seen_through |= meeting.through
    return ~seen_through | (layer.measured & (balance > 0))


def better_elsewhere(
    number: int, layers: Sequence[Layer], met: Iterator[Meeting], transforms: Transforms
) -> Mask:
    """Which pixels of view `number` show what another view measured with a finer footprint, or at
    all where they were filled in."""
    layer = layers[number]
    own = 1 / layer.inverse / layer.image.K[0, 0]
    better = np.zeros(own.shape, bool)
    for meeting in met:
        ratio = depth_ratio(layer.inverse, transforms[number, meeting.other])
        footprint = ratio / layer.inverse / layers[meeting.other].image.K[0, 0]
        limit = own / FINER if meeting.other < number else own * FINER
        better |= meeting.same & (~layer.measured | (footprint < limit))
    return better


def depth_ratio(inverse: Map, transform: Float32[np.ndarray, "3 4"]) -> Float[np.ndarray, "h w"]:
    """z-depth of each pixel's surface in another view over that in its own."""
    h, w = inverse.shape
    x, y = np.arange(w) + 0.5, np.arange(h)[:, None] + 0.5
    a, b, c, d = transform[2]
    return a * x + b * y + c + d * inverse
