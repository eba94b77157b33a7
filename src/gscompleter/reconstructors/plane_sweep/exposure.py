"""How brightly each photograph was exposed, told by the surfaces that several of them show.

Cameras choose exposure and white balance anew for each photograph. What two of them measured as the
same surface tells the ratio of their gains in each colour channel; all pairs together tell the gain
of each, relative to the mean of all.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from gscompleter.reconstructors.plane_sweep.fusion import Layer, Transforms, meetings

DARKEST, BRIGHTEST = 0.05, 0.95
"""Values between which a colour tells a ratio: darker ones are noise, brighter ones may be
clipped."""
MIN_SHARED = 0.01
"""Share of a photograph's pixels that another one has to show well exposed, so that the two are
compared."""
SAME_PATCH = 0.01
"""Share of a photograph's pixels that are wrong together, as far as they are wrong."""
SIDE = 128
"""Rows and columns of a photograph whose pixels are compared, about: more tell no more."""
PAIR_NOISE = 0.02
"""Standard deviation of the log-ratio of a pair that shares everything: surfaces shine, and images
darken towards their corners."""
EXPOSURE, TINT = 0.3, 0.1
"""Standard deviation of the log-gains of photographs: of all channels together, and of each beside
that. What pairs hardly tell stays near 0."""
HALF_A_STOP = 0.5 * math.log(2)
"""Logarithm of the ratio between the brightest and the darkest photograph, in any channel, from
which on they are evened out. Less hardly shows, and every render would be farther from its
photograph."""

Gains = Float[np.ndarray, "views 3"]


@dataclass(frozen=True)
class Ratio:
    """How much brighter one photograph shows the same surfaces than another, in logarithms."""

    pair: tuple[int, int]
    log: Float[np.ndarray, "3"]
    """Log of the first one's colours over the second one's."""
    weight: Float[np.ndarray, "3"]
    """Inverse variance; 0 where a channel tells nothing."""


def gains_of(layers: Sequence[Layer], transforms: Transforms) -> Gains:
    """Factors by which each photograph is brighter than the mean of all, by channel.

    They are the most likely ones, given the ratios of all pairs, and their logarithms have the mean
    0. Where the photographs are exposed about alike all of them are exactly 1.
    """
    logs = log_gains(ratios_among(layers, transforms), len(layers))
    return np.exp(logs) if np.ptp(logs, axis=0).max() > HALF_A_STOP else np.ones_like(logs)


def log_gains(ratios: Iterable[Ratio], count: int) -> Gains:
    """The log-gains of `count` photographs, by least squares."""
    usual = EXPOSURE**2 * np.ones((3, 3)) + TINT**2 * np.eye(3)
    precision = np.kron(np.eye(count), np.linalg.inv(usual))
    pull = np.zeros((count, 3))
    for ratio in ratios:
        apart = np.zeros(count)
        apart[list(ratio.pair)] = 1, -1
        precision += np.kron(np.outer(apart, apart), np.diag(ratio.weight))
        pull += np.outer(apart, ratio.weight * ratio.log)
    return np.linalg.solve(precision, pull.reshape(-1)).reshape(count, 3)


def ratios_among(layers: Sequence[Layer], transforms: Transforms) -> Iterator[Ratio]:
    """The ratio of every two photographs, as the pixels of either tell it."""
    measured = [layer.measured for layer in layers]
    for number, layer in enumerate(layers):
        step = max(1, min(layer.image.size) // SIDE)
        for meeting in meetings(number, layers, measured, transforms):
            same = (meeting.same & layer.measured)[::step, ::step]
            rows, columns = (step * at for at in np.nonzero(same))
            own = layer.image.image[rows, columns]
            there = transforms[number, meeting.other]
            other = colours_at(layers[meeting.other], carried(layer, rows, columns, there))
            yield ratio_between((number, meeting.other), own, other, same.size)


def ratio_between(
    pair: tuple[int, int],
    own: Float[np.ndarray, "n 3"],
    other: Float[np.ndarray, "n 3"],
    compared: int,
) -> Ratio:
    """The ratio of two photographs by the colours of the same surfaces: the median, which does not
    mind reflections and wrong depths. `compared` pixels were looked at."""
    log, weight = np.zeros(3), np.zeros(3)
    exposed = (np.minimum(own, other) > DARKEST) & (np.maximum(own, other) < BRIGHTEST)
    for channel in np.flatnonzero(exposed.sum(axis=0) > MIN_SHARED * compared):
        told = exposed[:, channel]
        logs = np.log(own[told, channel] / other[told, channel])
        log[channel] = np.median(logs)
        spread = 1.4826 * np.median(np.abs(logs - log[channel]))
        weight[channel] = 1 / (PAIR_NOISE**2 + spread**2 * SAME_PATCH * compared / len(logs))
    return Ratio(pair, log, weight)


def carried(
    layer: Layer,
    rows: Int[np.ndarray, "n"],
    columns: Int[np.ndarray, "n"],
    transform: Float32[np.ndarray, "3 4"],
) -> Float[np.ndarray, "n 2"]:
    """Where the surfaces at some pixels of a view lie in another view, in pixels."""
    inverse = layer.inverse[rows, columns]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows)), inverse], axis=-1)
    moved = pixels @ transform.T
    return moved[:, :2] / moved[:, 2:]


def colours_at(layer: Layer, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """What a photograph shows at the pixels nearest to `pixels`."""
    h, w = layer.image.size
    columns, rows = pixels.astype(int).clip(0, [w - 1, h - 1]).T
    return layer.image.image[rows, columns]
