"""Exposure gains of photographs, from the surfaces that several of them observe.

Each pair of photographs gives a colour ratio per channel; least squares over all pairs gives the
gains.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from gscompleter.reconstructors.plane_sweep.fusion import Layer, Transforms, compare_with_views

DARKEST, BRIGHTEST = 0.05, 0.95
"""Range of usable colours: darker values are noise, brighter ones may be clipped."""
MIN_SHARED = 0.01
"""Fraction of well exposed pixels that two photographs must share to be compared."""
CORRELATED_SHARE = 0.01
"""Fraction of a photograph's pixels whose errors are correlated."""
NUM_SAMPLED_ROWS = 128
"""Approximate number of rows and columns that are sampled in a photograph."""
PAIR_NOISE = 0.02
"""Standard deviation of a pair's log-ratio, due to reflections and vignetting."""
EXPOSURE, TINT = 0.3, 0.1
"""Prior standard deviations of the log-gains: common to all channels, and per channel."""
MIN_LOG_SPREAD = 0.5 * math.log(2)
"""Smallest spread of the log-gains that is corrected; less is hardly visible."""

Gains = Float[np.ndarray, "views 3"]


@dataclass(frozen=True)
class ColorRatio:
    """Log colour ratio of two photographs on the same surfaces."""

    pair: tuple[int, int]
    log: Float[np.ndarray, "3"]
    """Logarithm of the first photograph's colours over the second's."""
    weight: Float[np.ndarray, "3"]
    """Inverse variance; 0 for a channel without data."""


def estimate_gains(layers: Sequence[Layer], transforms: Transforms) -> Gains:
    """Estimate how much brighter each photograph is than their mean, per channel.

    The log-gains have mean 0. All gains are exactly 1 if they differ by less than `MIN_LOG_SPREAD`.
    """
    logs = solve_log_gains(measure_ratios(layers, transforms), len(layers))
    return np.exp(logs) if np.ptp(logs, axis=0).max() > MIN_LOG_SPREAD else np.ones_like(logs)


def solve_log_gains(ratios: Iterable[ColorRatio], count: int) -> Gains:
    """Solve for the log-gains of `count` photographs by least squares with a prior."""
    usual = EXPOSURE**2 * np.ones((3, 3)) + TINT**2 * np.eye(3)
    precision = np.kron(np.eye(count), np.linalg.inv(usual))
    pull = np.zeros((count, 3))
    for ratio in ratios:
        apart = np.zeros(count)
        apart[list(ratio.pair)] = 1, -1
        precision += np.kron(np.outer(apart, apart), np.diag(ratio.weight))
        pull += np.outer(apart, ratio.weight * ratio.log)
    return np.linalg.solve(precision, pull.reshape(-1)).reshape(count, 3)


def measure_ratios(layers: Sequence[Layer], transforms: Transforms) -> Iterator[ColorRatio]:
    """Yield the colour ratio of every ordered pair of photographs."""
    measured = [layer.measured_mask for layer in layers]
    for number, layer in enumerate(layers):
        step = max(1, min(layer.image.size) // NUM_SAMPLED_ROWS)
        for meeting in compare_with_views(number, layers, measured, transforms):
            same = (meeting.same_surface_mask & layer.measured_mask)[::step, ::step]
            rows, columns = (step * at for at in np.nonzero(same))
            own = layer.image.image[rows, columns]
            there = transforms[number, meeting.other]
            other = sample_colors(
                layers[meeting.other], project_to_view(layer, rows, columns, there)
            )
            yield measure_ratio((number, meeting.other), own, other, same.size)


def measure_ratio(
    pair: tuple[int, int],
    own: Float[np.ndarray, "n 3"],
    other: Float[np.ndarray, "n 3"],
    num_sampled: int,
) -> ColorRatio:
    """Compute the median log-ratio of two photographs over `num_sampled` pixels."""
    log, weight = np.zeros(3), np.zeros(3)
    exposed = (np.minimum(own, other) > DARKEST) & (np.maximum(own, other) < BRIGHTEST)
    for channel in np.flatnonzero(exposed.sum(axis=0) > MIN_SHARED * num_sampled):
        valid = exposed[:, channel]
        logs = np.log(own[valid, channel] / other[valid, channel])
        log[channel] = np.median(logs)
        spread = 1.4826 * np.median(np.abs(logs - log[channel]))
        weight[channel] = 1 / (
            PAIR_NOISE**2 + spread**2 * CORRELATED_SHARE * num_sampled / len(logs)
        )
    return ColorRatio(pair, log, weight)


def project_to_view(
    layer: Layer,
    rows: Int[np.ndarray, "n"],
    columns: Int[np.ndarray, "n"],
    transform: Float32[np.ndarray, "3 4"],
) -> Float[np.ndarray, "n 2"]:
    """Project the surfaces at some pixels into another view, in pixels."""
    inverse = layer.inverse[rows, columns]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows)), inverse], axis=-1)
    moved = pixels @ transform.T
    return moved[:, :2] / moved[:, 2:]


def sample_colors(layer: Layer, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Sample the colours of a photograph at the nearest pixels."""
    h, w = layer.image.size
    columns, rows = pixels.astype(int).clip(0, [w - 1, h - 1]).T
    return layer.image.image[rows, columns]
