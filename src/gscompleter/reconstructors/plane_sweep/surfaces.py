"""Plane pieces from uncertain depths: total generalized variation (Bredies, Kunisch and Pock 2010;
for stereo Ranftl et al. 2012).

The inverse depth of a plane is linear in the pixel. A map of inverse depths that bends as little as
its measurements allow is therefore made of planes, and where nothing was measured, at the border of
the frame or on a blank wall, the planes around go on; they end at the edges of the image.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float32

from gscompleter.interpolation import fill_smoothly
from gscompleter.kernels import variation
from gscompleter.matching.stereo_image import contrast

Image = Float32[np.ndarray, "h w 3"]
Map = Float32[np.ndarray, "h w"]
AnyMap = Float32[np.ndarray, "_ _"]
Level = tuple[AnyMap, AnyMap, Float32[np.ndarray, "_ _ 3"]]
"""Measurements, their weights, and the image, all of one size."""

# Heights are inverse depths, in steps between the planes of the sweep.
STEP_PENALTY = 3.0
"""Cost of a step by one plane where the image is even; a measurement that counts in full costs 1
per plane that is missed."""
BEND_PENALTY = 12.0
"""Cost of a change of slope by one plane per pixel."""
EDGE_CONTRAST = 0.1
"""Difference of colour at which a step costs 1/e of that."""
LEAST_PENALTY = 0.02
"""Cost of a step at the strongest edge, relative to one where the image is even."""
TOLERANCE = 0.15
"""Planes by which a measurement may be off as a matter of course."""
LEVELS = 5
"""Levels of the pyramid, each of half the size; planes travel far on the coarse ones."""
ITERATIONS = 100
"""Steps on the finest level, and twice as many on each coarser one, where they cost little."""


def fit_surfaces(measured: Map, confidence: Map, image: Image) -> Map:
    """Heights [h, w] that follow `measured` as far as `confidence` [h, w] in [0, 1] goes.

    Where nothing at all is measured, the result is `measured`.
    """
    if not (confidence > 0).any():
        return measured
    levels: list[Level] = [(measured, confidence, image)]
    while len(levels) < LEVELS and min(levels[-1][0].shape) > 4:
        levels.append(halved(*levels[-1]))
    heights = beginning(*levels[-1][:2])
    slopes = np.zeros((2, *heights.shape), np.float32)
    for number, (data, weight, colours) in reversed(list(enumerate(levels))):
        if heights.shape != data.shape:
            heights = doubled(heights, data.shape)
            slopes = np.stack([doubled(slope, data.shape) / 2 for slope in slopes])
        # A coarse pixel holds 4 ** number fine ones; its steps are 2 ** number times as high.
        scale = 2.0**number
        across, down = (cost / np.float32(scale) for cost in step_costs(colours))
        bend, tolerance = np.float32(BEND_PENALTY / scale**2), np.float32(TOLERANCE)
        steps = ITERATIONS * 2**number
        variation.fit(heights, slopes, data, weight, across, down, bend, tolerance, steps)
    return heights


def beginning(data: AnyMap, weight: AnyMap) -> AnyMap:
    """What was measured, continued smoothly."""
    return fill_smoothly(torch.from_numpy(data), torch.from_numpy(weight > 0)).numpy().copy()


def step_costs(image: Image) -> tuple[Map, Map]:
    """What a step to the right neighbour costs, and to the one below: less at an edge."""

    def cost(beside: Image) -> Map:
        share = np.maximum(np.exp(-contrast(image, beside) / EDGE_CONTRAST), LEAST_PENALTY)
        return (STEP_PENALTY * share).astype(np.float32)

    right, below = np.append(image[:, 1:], image[:, -1:], 1), np.append(image[1:], image[-1:], 0)
    return cost(right), cost(below)


def halved(data: Map, weight: Map, image: Image) -> Level:
    """A level of half the size; measurements are averaged by their weights."""
    h, w = data.shape
    size = (h + 1) // 2, (w + 1) // 2

    def sums(values: Map) -> AnyMap:
        padded = np.pad(values, ((0, size[0] * 2 - h), (0, size[1] * 2 - w)))
        return padded.reshape(size[0], 2, size[1], 2).sum(axis=(1, 3))

    total = sums(weight)
    mean = sums(weight * data) / np.maximum(total, np.float32(1e-9))
    area = sums(np.ones_like(data))
    smaller = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
    return mean, total / area, smaller


def doubled(values: AnyMap, shape: tuple[int, ...]) -> AnyMap:
    return cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
