"""Depth from elsewhere, anchored to stereo and tested on blocks of stereo that are hidden from it.

A network knows depth up to an affine function of inverse depth, and its error varies slowly over
the image; errors of the poses bend what stereo measures in the same way. So an affine function and
a smooth field bring the one to the other, and what is left to test is the shape of the surfaces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Int

from gscompleter.numerics.image_ops import push_pull
from gscompleter.numerics.robust import fit_line_ransac
from gscompleter.reconstructors.plane_sweep.surfaces import (
    SMOOTHING_ITERATIONS,
    ColorImage,
    fit_surfaces,
)
from gscompleter.reconstructors.plane_sweep.sweep import (
    Map,
    Mask,
    Measurement,
    compute_inverse_depth,
    compute_plane_index,
)

MIN_CONFIDENCE = 0.5
"""Confidence from which a measured pixel anchors depth and tests it."""
MIN_HIDDEN_PIXELS = 200
"""Fewest such pixels, for an anchor and for a test."""
MIN_SURE_SHARE = 0.25
"""Smallest share of such pixels for a test. With less, as in a room of blank walls, a third of what
stereo is sure of is wrong, and true depth would contradict it."""
MAX_AFFINE_PIXELS = 8192
"""Most pixels of the affine fit, evenly spaced among all."""
WEIGHT = np.float32(0.1)
"""Weight of an anchored pixel in the surface fit; a confident measurement has 1."""

NUM_PARTS = 3
"""Number of parts that blocks are hidden in, one after the other."""
MIN_BLOCK, MAX_BLOCK = 1 / 8, 1 / 3
"""Smallest and largest side of a block, relative to the shorter side of the image."""
MAX_LOG_ERROR = 0.5
"""Largest absolute error of a logarithm of depth that counts; a blunder says no more than that."""
TEST_SIDE = 256
"""Shorter side, in pixels, that a test needs: it takes every n-th pixel of an image n times as
large."""


@dataclass(frozen=True)
class BlockErrors:
    """Mean absolute errors of the logarithm of depth in hidden blocks of stereo."""

    supported: float
    """With the anchored depth in the blocks; infinite if it cannot be anchored."""
    continued: float
    """With the surfaces continued from around the blocks."""

    @property
    def is_anchored(self) -> bool:
        """True if a positive scale brings the depth to stereo."""
        return math.isfinite(self.supported)

    @property
    def ratio(self) -> float:
        """Error with the depth over that without it; below 1 the depth tells more."""
        return self.supported / max(self.continued, 1e-9)


def anchor_depth(guess: Map, measured: Measurement, anchors: Mask) -> Map | None:
    """Bring inverse depths, 0 at infinity, to the measured ones at the pixels of `anchors`.

    RANSAC fits scale and shift; the ratio that is left is interpolated smoothly. None if no
    positive scale fits: far things would be near, or nothing would be nearer than anything else.
    """
    places = np.flatnonzero(anchors)
    sample = places[:: -(-len(places) // MAX_AFFINE_PIXELS)]
    inverse = compute_inverse_depth(measured.planes, measured.index)
    x = torch.from_numpy(guess.ravel()[sample]).double()
    y = torch.from_numpy(inverse.ravel()[sample]).double()
    scale, shift = fit_line_ransac(x, y, torch.Generator().manual_seed(0))
    if scale <= 0:
        return None

    # At most twice as far as the far plane; the shift may bring inverse depths to 0 and below.
    farthest = measured.planes[0] / 2
    bent = np.maximum(scale * guess + shift, farthest).astype(np.float32)
    log_ratio = np.where(anchors, np.log(inverse / bent), 0).astype(np.float32)
    field = push_pull(
        torch.from_numpy(log_ratio)[..., None], torch.from_numpy(anchors.astype(np.float32))
    )
    return np.maximum(bent * np.exp(field[..., 0].numpy()), farthest).astype(np.float32)


def support(measured: Measurement, inverse: Map, known: Mask) -> Measurement:
    """Use inverse depths at `known` pixels in which nothing is measured, as weak observations."""
    empty = known & (measured.weight == 0)
    index = np.where(empty, compute_plane_index(measured.planes, inverse), measured.index)
    return Measurement(
        measured.planes, index, np.where(empty, WEIGHT, measured.weight), measured.confidence
    )


def compare_in_hidden_blocks(
    guess: Map,
    known: Mask,
    measured: Measurement,
    image: ColorImage,
    iterations: int = SMOOTHING_ITERATIONS // 2,
) -> BlockErrors | None:
    """Compare what inverse depths tell about hidden blocks of stereo.

    They are used at `known` pixels, and are 0 at infinity. Against them stand the surfaces that are
    continued without them. Every measured block is hidden once. None if too little is measured to
    compare with.
    """
    # The blocks grow with the image, so that small ones test the same.
    step = max(1, min(guess.shape) // TEST_SIDE)
    measured = Measurement(
        measured.planes,
        *(
            np.ascontiguousarray(values[::step, ::step])
            for values in (measured.index, measured.weight, measured.confidence)
        ),
    )
    guess = np.ascontiguousarray(guess[::step, ::step])
    known = np.ascontiguousarray(known[::step, ::step])
    image = np.ascontiguousarray(image[::step, ::step])

    sure = known & (measured.confidence >= MIN_CONFIDENCE)
    if sure.sum() < MIN_SURE_SHARE * known.sum():
        return None
    truth = compute_inverse_depth(measured.planes, measured.index)
    parts = divide_into_blocks(measured.weight == 0)
    supported: list[Float32[np.ndarray, "_"]] = []
    continued: list[Float32[np.ndarray, "_"]] = []
    for part in range(NUM_PARTS):
        hidden = parts == part
        tested = sure & hidden
        anchors = sure & ~hidden
        if not tested.any() or anchors.sum() < MIN_HIDDEN_PIXELS:
            continue
        anchored = anchor_depth(guess, measured, anchors)
        if anchored is None:
            return BlockErrors(math.inf, 0.0)
        rest = measured.exclude(hidden)
        for errors, observed in (
            (continued, rest),
            (supported, support(rest, anchored, known)),
        ):
            index = fit_surfaces(observed.index, observed.weight, image, iterations)
            found = compute_inverse_depth(measured.planes, index)
            errors.append(np.minimum(np.abs(np.log(found / truth))[tested], MAX_LOG_ERROR))
    if sum(len(errors) for errors in supported) < MIN_HIDDEN_PIXELS:
        return None
    return BlockErrors(
        float(np.concatenate(supported).mean(dtype=np.float64)),
        float(np.concatenate(continued).mean(dtype=np.float64)),
    )


def divide_into_blocks(empty: Mask) -> Int[np.ndarray, "h w"]:
    """Divide the pixels into blocks, and number the part that each block belongs to.

    No two blocks of a part share a side. They are about as wide as what is `empty`: the wider that
    is, the less is known by continuing.
    """
    # The distance from the border of a square is a sixth of its side in the mean. What lies beyond
    # the image is not known either.
    padded = np.pad(empty, 1, constant_values=True).astype(np.uint8)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1]
    width = 6 * float(distance[empty].mean()) if empty.any() and not empty.all() else 0.0
    shortest = min(empty.shape)
    side = max(1, round(min(max(width, MIN_BLOCK * shortest), MAX_BLOCK * shortest)))
    rows, columns = np.indices(empty.shape) // side
    return (rows + columns) % NUM_PARTS
