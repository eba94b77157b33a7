"""Piecewise planar surfaces from uncertain depths, by total generalized variation.

After Bredies, Kunisch and Pock (2010), and Ranftl et al. (2012) for stereo. Inverse depth is linear
on a plane, so a map with little bending consists of planes, which continue into unmeasured areas.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float32

from gscompleter.numerics.image_ops import fill_smoothly
from gscompleter.numerics.kernels import tgv
from gscompleter.reconstructors.features.stereo_image import compute_contrast

Image = Float32[np.ndarray, "h w 3"]
Map = Float32[np.ndarray, "h w"]
AnyMap = Float32[np.ndarray, "_ _"]
Level = tuple[AnyMap, AnyMap, Float32[np.ndarray, "_ _ 3"]]

# Heights are inverse depths, in planes of the sweep.
STEP_PENALTY = 3.0
"""Cost of a one-plane step in a uniform area; a measurement costs 1 per missed plane."""
BEND_PENALTY = 12.0
"""Cost of a gradient change by one plane per pixel."""
EDGE_CONTRAST = 0.1
"""Colour difference at which the cost of a step falls to 1/e."""
MIN_STEP_SHARE = 0.02
"""Relative cost of a step at the strongest edge."""
TOLERANCE = 0.15
"""Measurement error without cost, in planes."""
LEVELS = 5
"""Number of pyramid levels; coarse ones carry planes over long distances."""
ITERATIONS = 100
"""Iterations on the finest level, doubled on each coarser one."""


def fit_surfaces(measured: Map, confidence: Map, image: Image, iterations: int = ITERATIONS) -> Map:
    """Fit inverse depths to measurements with weights in [0, 1].

    Without a positive weight or an iteration they stay as measured.
    """
    if iterations == 0 or not (confidence > 0).any():
        return measured
    levels: list[Level] = [(measured, confidence, image)]
    while len(levels) < LEVELS and min(levels[-1][0].shape) > 4:
        levels.append(halve_level(*levels[-1]))
    known, sure, _ = (torch.from_numpy(part) for part in levels[-1])
    heights = fill_smoothly(known, sure > 0).numpy().copy()
    gradients = np.zeros((2, *heights.shape), np.float32)
    for number, (data, weight, colours) in reversed(list(enumerate(levels))):
        if heights.shape != data.shape:
            heights = upsample_bilinear(heights, data.shape)
            gradients = np.stack([upsample_bilinear(part, data.shape) / 2 for part in gradients])
        # A coarse pixel covers 4 ** number fine ones, and its steps are 2 ** number times higher.
        scale = 2.0**number
        across, down = (cost / np.float32(scale) for cost in compute_step_costs(colours))
        bend, tolerance = np.float32(BEND_PENALTY / scale**2), np.float32(TOLERANCE)
        steps = iterations * 2**number
        tgv.fit(heights, gradients, data, weight, across, down, bend, tolerance, steps)
    return heights


def compute_step_costs(image: Image) -> tuple[Map, Map]:
    """Compute the cost of a step to the right and lower neighbour; low at edges."""

    def cost(beside: Image) -> Map:
        share = np.maximum(np.exp(-compute_contrast(image, beside) / EDGE_CONTRAST), MIN_STEP_SHARE)
        return (STEP_PENALTY * share).astype(np.float32)

    right, below = np.append(image[:, 1:], image[:, -1:], 1), np.append(image[1:], image[-1:], 0)
    return cost(right), cost(below)


def halve_level(data: Map, weight: Map, image: Image) -> Level:
    """Halve a pyramid level; measurements are averaged by weight."""
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


def upsample_bilinear(values: AnyMap, shape: tuple[int, ...]) -> AnyMap:
    """Upsample bilinearly to `shape`."""
    return cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
