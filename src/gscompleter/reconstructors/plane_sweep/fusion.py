"""Fusion of depth maps: each surface once, nothing in observed free space, in one exposure.

Each pair of photographs gives a colour ratio per channel on the surfaces that both observe; least
squares over all pairs gives the exposure gains.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from gscompleter.numerics.image_ops import BRIGHTEST, DARKEST
from gscompleter.numerics.kernels import stereo
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.rig import Transform, Transforms
from gscompleter.reconstructors.plane_sweep.sweep import MAX_RETURN_ERROR, UNKNOWN, Map, Mask

MAX_DEPTH_DIFFERENCE = 0.05
"""Largest relative depth difference between two views of the same surface."""
FINER_FOOTPRINT = 0.9
"""Footprint ratio below which another view is finer; otherwise the first view is kept."""

MIN_SHARED_EXPOSURE = 0.01
"""Fraction of well exposed pixels that two photographs must share to be compared."""
CORRELATED_SHARE = 0.01
"""Fraction of a photograph's pixels whose errors are correlated."""
NUM_SAMPLED_ROWS = 128
"""Approximate number of rows and columns that are sampled in a photograph."""
PAIR_NOISE = 0.02
"""Standard deviation of a pair's log-ratio, due to reflections and vignetting."""
EXPOSURE = 0.3
"""Prior standard deviation of the log-gain that is common to all channels."""
TINT = 0.1
"""Prior standard deviation of the log-gain of a single channel."""
MIN_LOG_SPREAD = 0.5 * math.log(2)
"""Smallest spread of the log-gains that is corrected; less is hardly visible."""

Gains = Float[np.ndarray, "views 3"]
ColorRatio = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
"""Logarithm of a photograph's colours over another's, and its inverse variance; 0 without data."""


@dataclass(frozen=True)
class DepthLayer:
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


@dataclass(frozen=True)
class DepthComparison:
    """Pixels of one view compared with the measured depths of another view."""

    other: int
    free_space_mask: Mask
    """True if the other view sees a surface behind the pixel."""
    same_surface_mask: Mask
    """True if the other view measured the same surface."""


def compare_with_views(
    number: int, layers: Sequence[DepthLayer], kept: Sequence[Mask], transforms: Transforms
) -> Iterator[DepthComparison]:
    """Compare view `number` with the measured and `kept` pixels of each other view.

    A pixel is in free space if its surface, seen from the other view, would stand before the one
    that is measured there. Hidden pixels, behind that surface, are neither.
    """
    inverse = layers[number].inverse
    for other, layer in enumerate(layers):
        if other == number:
            continue
        there = transforms[number, other]
        back = transforms[other, number]
        sure = np.where(layer.measured_mask & kept[other], layer.inverse, UNKNOWN)
        # `ratio` is z as expected in the other view over z as measured there; near 0 it is unknown.
        error, ratio = stereo.reproject(inverse, sure, there, back)
        known = (error >= 0) & (ratio > 1e-3)
        apart = error > MAX_RETURN_ERROR
        through = known & apart & (ratio < 1 - MAX_DEPTH_DIFFERENCE)
        same = known & ~apart & (np.abs(ratio - 1) < MAX_DEPTH_DIFFERENCE)
        yield DepthComparison(other, through, same)


def find_free_pixels(layers: Sequence[DepthLayer], transforms: Transforms) -> list[Mask]:
    """Find the pixels of each view that are outside the free space of all other views.

    No view sees through them, or more views confirm than refute them.
    """
    everywhere = [np.ones_like(layer.measured_mask) for layer in layers]
    outside = []
    for number, layer in enumerate(layers):
        balance = np.zeros(layer.inverse.shape, np.int32)
        seen_through = np.zeros(layer.inverse.shape, bool)
        for meeting in compare_with_views(number, layers, everywhere, transforms):
            balance += meeting.same_surface_mask.astype(np.int32) - meeting.free_space_mask
            seen_through |= meeting.free_space_mask
        outside.append(~seen_through | (layer.measured_mask & (balance > 0)))
    return outside


def find_finest_pixels(
    layers: Sequence[DepthLayer], free: Sequence[Mask], transforms: Transforms
) -> list[Mask]:
    """Find the `free` pixels of each view whose surface no other view measured better.

    Another view measures better if the pixel is interpolated here, or coarser.
    """
    finest = []
    for number, layer in enumerate(layers):
        # Width of the pixel on the surface: z over focal length, in widest baselines.
        own = 1 / layer.inverse / layer.image.K[0, 0]
        better = np.zeros(own.shape, bool)
        for meeting in compare_with_views(number, layers, free, transforms):
            ratio = compute_depth_ratio(layer.inverse, transforms[number, meeting.other])
            footprint = ratio / layer.inverse / layers[meeting.other].image.K[0, 0]
            # Of two views of about the same resolution the first one keeps the surface. Both
            # limits are inverse to each other, so that never both views drop it.
            limit = own / FINER_FOOTPRINT if meeting.other < number else own * FINER_FOOTPRINT
            better |= meeting.same_surface_mask & (~layer.measured_mask | (footprint < limit))
        finest.append(free[number] & ~better)
    return finest


def compute_depth_ratio(inverse: Map, transform: Transform) -> Float[np.ndarray, "h w"]:
    """Compute the z-depth of each surface in another view over that in its own view."""
    h, w = inverse.shape
    x = np.arange(w) + 0.5
    y = np.arange(h)[:, None] + 0.5
    a, b, c, d = transform[2]
    return a * x + b * y + c + d * inverse


def estimate_gains(layers: Sequence[DepthLayer], transforms: Transforms) -> Gains:
    """Estimate how much brighter each photograph is than their mean, per channel.

    The log-gains have mean 0. All gains are exactly 1 for two photographs, whose colours depend on
    the direction instead (decision 043), and if they differ by less than `MIN_LOG_SPREAD`
    (decision 018).
    """
    if len(layers) == 2:
        return np.ones((2, 3))
    logs = solve_log_gains(measure_ratios(layers, transforms), len(layers))
    if np.ptp(logs, axis=0).max() > MIN_LOG_SPREAD:
        return np.exp(logs)
    return np.ones_like(logs)


def solve_log_gains(ratios: Iterable[tuple[list[int], ColorRatio]], count: int) -> Gains:
    """Solve for the log-gains of `count` photographs by least squares with a prior.

    The normal equations are those of a graph: photographs are nodes, and each ratio states the
    difference of the log-gains at both ends of an edge.
    """
    # The prior keeps photographs without a common surface near gain 1, and makes the mean 0.
    covariance = EXPOSURE**2 * np.ones((3, 3)) + TINT**2 * np.eye(3)
    precision = np.kron(np.eye(count), np.linalg.inv(covariance))
    pull = np.zeros((count, 3))
    for pair, (log, weight) in ratios:
        difference = np.zeros(count)
        difference[pair] = 1, -1
        precision += np.kron(np.outer(difference, difference), np.diag(weight))
        pull += np.outer(difference, weight * log)
    return np.linalg.solve(precision, pull.reshape(-1)).reshape(count, 3)


def measure_ratios(
    layers: Sequence[DepthLayer], transforms: Transforms
) -> Iterator[tuple[list[int], ColorRatio]]:
    """Yield the colour ratio of every ordered pair of photographs."""
    measured = [layer.measured_mask for layer in layers]
    for number, layer in enumerate(layers):
        step = max(1, min(layer.image.size) // NUM_SAMPLED_ROWS)
        for meeting in compare_with_views(number, layers, measured, transforms):
            same = (meeting.same_surface_mask & layer.measured_mask)[::step, ::step]
            sampled_rows, sampled_columns = np.nonzero(same)
            rows = step * sampled_rows
            columns = step * sampled_columns
            own = layer.image.image[rows, columns]
            there = transforms[number, meeting.other]
            other = sample_colors(layer, rows, columns, layers[meeting.other].image, there)
            yield [number, meeting.other], measure_ratio(own, other, same.size)


def measure_ratio(
    own: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"], num_sampled: int
) -> ColorRatio:
    """Compute the median log-ratio of two photographs over `num_sampled` pixels."""
    log = np.zeros(3)
    weight = np.zeros(3)
    exposed = (np.minimum(own, other) > DARKEST) & (np.maximum(own, other) < BRIGHTEST)
    for channel in np.flatnonzero(exposed.sum(axis=0) > MIN_SHARED_EXPOSURE * num_sampled):
        valid = exposed[:, channel]
        logs = np.log(own[valid, channel] / other[valid, channel])
        # Reflections and false surfaces are outliers, so median and median deviation (scaled to a
        # standard deviation) take the place of mean and standard deviation.
        log[channel] = np.median(logs)
        spread = 1.4826 * np.median(np.abs(logs - log[channel]))
        # Errors of neighbouring pixels are not independent: as many pixels as one region of
        # correlated errors holds count as one.
        variance = spread**2 * CORRELATED_SHARE * num_sampled / len(logs)
        weight[channel] = 1 / (PAIR_NOISE**2 + variance)
    return log, weight


def sample_colors(
    layer: DepthLayer,
    rows: Int[np.ndarray, "n"],
    columns: Int[np.ndarray, "n"],
    other: StereoImage,
    transform: Transform,
) -> Float[np.ndarray, "n 3"]:
    """Sample the colours of another photograph at the surfaces of some pixels of a layer."""
    inverse = layer.inverse[rows, columns]
    moved = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows)), inverse], 1) @ transform.T
    h, w = other.size
    # Pixel (x, y) covers [x, x + 1), so that truncation gives the pixel a point lies in.
    x, y = (moved[:, :2] / moved[:, 2:]).astype(int).clip(0, [w - 1, h - 1]).T
    return other.image[y, x]
