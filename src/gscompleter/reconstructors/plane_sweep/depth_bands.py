"""Depth bands: the range of planes that each image tile is matched at."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, Int

from gscompleter.kernels.stereo import TILE_COLUMNS, TILE_ROWS, Bands

Map = Float32[np.ndarray, "h w"]
MEDIAN_SIZE = 5
"""Size in pixels of the median filter that removes outliers from a first guess."""
GUESS_MARGIN = 1
"""Margin in pixels of the first guess by which a band includes surrounding depths."""
EXTRA_PLANES = 3
"""Extra planes on both sides of the guessed range."""


def make_full_bands(size: tuple[int, int], planes: int) -> Bands:
    """Create bands with all planes for an image of `size` (height, width)."""
    shape = compute_tile_grid(size)
    return make_bands(np.zeros(shape, int), np.full(shape, planes), size)


def make_guided_bands(guess: Map, shrinkage: int, size: tuple[int, int], planes: int) -> Bands:
    """Create bands around the planes `guess` of an image `1 / shrinkage` the size.

    `size` is the height and width of the full image, `planes` the number of planes.
    """
    likely = cv2.medianBlur(guess, MEDIAN_SIZE)
    window = np.ones((2 * GUESS_MARGIN + 1, 2 * GUESS_MARGIN + 1), np.uint8)
    lowest = reduce_tiles(np.minimum, cv2.erode(likely, window), shrinkage, size)
    highest = reduce_tiles(np.maximum, cv2.dilate(likely, window), shrinkage, size)
    low = (np.floor(lowest).astype(int) - EXTRA_PLANES).clip(0, planes - 1)
    high = (np.ceil(highest).astype(int) + EXTRA_PLANES + 1).clip(1, planes)
    return make_bands(low, high, size)


def reduce_tiles(
    extreme: np.ufunc, values: Map, shrinkage: int, size: tuple[int, int]
) -> Float32[np.ndarray, "r c"]:
    """Reduce the values of each tile with `extreme` (minimum or maximum)."""
    tops, lefts = (
        np.arange(count) * side // shrinkage
        for count, side in zip(compute_tile_grid(size), (TILE_ROWS, TILE_COLUMNS), strict=True)
    )
    return extreme.reduceat(extreme.reduceat(values, tops, axis=0), lefts, axis=1)


def compute_tile_grid(size: tuple[int, int]) -> tuple[int, int]:
    """Count the rows and columns of tiles."""
    return -(-size[0] // TILE_ROWS), -(-size[1] // TILE_COLUMNS)


def make_bands(
    low: Int[np.ndarray, "r c"], high: Int[np.ndarray, "r c"], size: tuple[int, int]
) -> Bands:
    """Build one band per tile, from plane `low` up to but excluding `high`."""
    rows, columns = compute_tile_grid(size)
    heights = np.diff(np.append(np.arange(rows) * TILE_ROWS, size[0]))
    widths = np.diff(np.append(np.arange(columns) * TILE_COLUMNS, size[1]))
    costs = heights[:, None] * widths * (high - low)
    start = np.append(0, np.cumsum(costs, dtype=np.int64))
    return Bands(low.astype(np.int32), high.astype(np.int32), start)
