"""Piecewise planar surfaces from uncertain depths, by total generalized variation.

After Bredies, Kunisch and Pock (2010), and Ranftl et al. (2012) for stereo. Inverse depth is linear
on a plane, so a map with little bending consists of planes, which continue into unmeasured areas.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float32

from gscompleter.numerics.image_ops import fill_smoothly
from gscompleter.numerics.kernels import tgv
from gscompleter.reconstructors.features.stereo_image import compute_contrast

ColorImage = Float32[np.ndarray, "h w 3"]
LevelMap = Float32[np.ndarray, "h w"]
AnyMap = Float32[np.ndarray, "_ _"]
PyramidLevel = tuple[AnyMap, AnyMap, Float32[np.ndarray, "_ _ 3"]]

# Heights are inverse depths, in planes of the sweep.
STEP_PENALTY = 3.0
"""Cost of a one-plane step in a uniform area; a measurement costs 1 per missed plane."""
BEND_PENALTY = 12.0
"""Cost of a gradient change by one plane per pixel."""
STEP_CONTRAST = 0.1
"""Colour difference at which the cost of a step falls to 1/e."""
MIN_STEP_SHARE = 0.02
"""Relative cost of a step at the strongest edge."""
MEASUREMENT_TOLERANCE = 0.15
"""Measurement error without cost, in planes."""
LEVELS = 5
"""Number of pyramid levels; coarse ones carry planes over long distances."""
SMOOTHING_ITERATIONS = 100
"""Iterations on the finest level, doubled on each coarser one."""


@runtime_checkable
class FitHeights(Protocol):
    """A fit of heights and their gradients, in place, as `fit` of the kernel `tgv`."""

    def __call__(
        self,
        heights: AnyMap,
        gradients: Float32[np.ndarray, "2 _ _"],
        data: AnyMap,
        weight: AnyMap,
        across: AnyMap,
        down: AnyMap,
        bend: np.float32,
        tolerance: np.float32,
        iterations: int,
    ) -> None:
        """Run the iterations of one level."""


def fit_surfaces(
    measured: LevelMap,
    confidence: LevelMap,
    image: ColorImage,
    iterations: int = SMOOTHING_ITERATIONS,
    choose_fit: Callable[[int], FitHeights] = lambda _: tgv.fit,
) -> LevelMap:
    """Fit inverse depths, in planes of the sweep, to measurements with weights in [0, 1].

    `measured` is finite also where `confidence` is 0, and counts for nothing there. `image` has
    colours in [0, 1], at whose edges surfaces may step. Without a positive weight or an iteration
    depths stay as measured. `choose_fit` returns the fit of a level with so many pixels.
    """
    if iterations == 0 or not (confidence > 0).any():
        return measured
    # Coarse to fine: an iteration carries heights to neighbouring pixels only, so that coarse
    # levels have to bring planes across large unmeasured areas.
    levels: list[PyramidLevel] = [(measured, confidence, image)]
    while len(levels) < LEVELS and min(levels[-1][0].shape) > 4:
        levels.append(halve_level(*levels[-1]))

    coarsest, coarsest_weight, _ = levels[-1]
    known = torch.from_numpy(coarsest_weight) > 0
    heights = fill_smoothly(torch.from_numpy(coarsest), known).numpy().copy()
    gradients = np.zeros((2, *heights.shape), np.float32)
    for number, (data, weight, colours) in reversed(list(enumerate(levels))):
        if heights.shape != data.shape:
            heights = upsample_bilinear(heights, data.shape)
            # A gradient is per pixel, and pixels are half as wide now.
            gradients = np.stack([upsample_bilinear(part, data.shape) / 2 for part in gradients])

        # A coarse pixel covers 4 ** number fine ones, and its steps are 2 ** number times higher.
        # So costs per pixel shrink, those of steps by 2 ** number, those of bends by its square.
        scale = 2.0**number
        step_right, step_down = compute_step_costs(colours)
        choose_fit(data.size)(
            heights,
            gradients,
            data,
            weight,
            across=step_right / np.float32(scale),
            down=step_down / np.float32(scale),
            bend=np.float32(BEND_PENALTY / scale**2),
            tolerance=np.float32(MEASUREMENT_TOLERANCE),
            iterations=iterations * 2**number,
        )
    return heights


def compute_step_costs(image: ColorImage) -> tuple[LevelMap, LevelMap]:
    """Compute the cost of a step to the right and lower neighbour; low at edges."""

    def compute_cost(beside: ColorImage) -> LevelMap:
        share = np.maximum(np.exp(-compute_contrast(image, beside) / STEP_CONTRAST), MIN_STEP_SHARE)
        return (STEP_PENALTY * share).astype(np.float32)

    right = np.append(image[:, 1:], image[:, -1:], 1)
    below = np.append(image[1:], image[-1:], 0)
    return compute_cost(right), compute_cost(below)


def halve_level(data: LevelMap, weight: LevelMap, image: ColorImage) -> PyramidLevel:
    """Halve a pyramid level; measurements are averaged by weight.

    At the end of an odd side a coarse pixel covers fewer fine ones; its weight is their mean.
    """
    h, w = data.shape
    height, width = (h + 1) // 2, (w + 1) // 2

    def sum_pixels(values: LevelMap) -> AnyMap:
        padded = np.pad(values, ((0, height * 2 - h), (0, width * 2 - w)))
        return padded.reshape(height, 2, width, 2).sum(axis=(1, 3))

    total = sum_pixels(weight)
    mean = sum_pixels(weight * data) / np.maximum(total, np.float32(1e-9))
    area = sum_pixels(np.ones_like(data))
    smaller = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return mean, total / area, smaller


def upsample_bilinear(values: AnyMap, shape: tuple[int, ...]) -> AnyMap:
    """Upsample bilinearly to `shape`."""
    return cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
