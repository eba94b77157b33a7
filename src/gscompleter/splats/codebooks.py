"""Few values that stand for many: codebooks of numbers and palettes of rows, by k-means."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float, Int32, Int64, UInt8
from numpy import ndarray

CODEBOOK_SIZE = 256
MIN_PALETTE_SIZE = 1 << 12
"""Entries of the palette of few rows."""
MAX_PALETTE_SIZE = 1 << 16
"""Most entries of a palette, whose numbers have 16 bits."""
ROWS_PER_ENTRY = 4
"""Rows that share an entry of a palette between these sizes."""
CODEBOOK_ITERATIONS = 5


def fit_codebook(
    values: Float[ndarray, "n k"],
) -> tuple[Float[ndarray, "256"], UInt8[ndarray, "n k"]]:
    """Fit 256 numbers to all values; return them in ascending order, and the nearest by number.

    Half of the first guess are quantiles, half cover the range, so that rare values stay close.
    """
    half = CODEBOOK_SIZE // 2
    covering = np.linspace(values.min(), values.max(), half)
    book = np.sort([*np.quantile(values, np.linspace(0, 1, half)), *covering])
    # Lloyd's iterations on numbers; an entry that is nearest to none stays where it is.
    for _ in range(CODEBOOK_ITERATIONS):
        nearest = _find_nearest(book, values).ravel()
        counts = np.bincount(nearest, minlength=CODEBOOK_SIZE)
        sums = np.bincount(nearest, values.ravel(), CODEBOOK_SIZE)
        book = np.where(counts > 0, sums / np.maximum(counts, 1), book)
    return book.astype(np.float32), _find_nearest(book, values).astype(np.uint8)


def fit_palette(
    rows: Float[ndarray, "n k"],
) -> tuple[Float[ndarray, "p k"], Int64[ndarray, "n"]]:
    """Fit up to 65,536 rows to rows, of which few are kept as they are; number the nearest.

    The space of rows is divided into as many cells as each has entries, which bounds the time.
    """
    # Few distinct rows are kept exactly.
    distinct, numbers = np.unique(rows, axis=0, return_inverse=True)
    size = min(max(MIN_PALETTE_SIZE, len(rows) // ROWS_PER_ENTRY), MAX_PALETTE_SIZE)
    if len(distinct) <= size:
        return distinct, numbers.reshape(-1)
    num_cells = math.isqrt(size)
    _, cell = _run_kmeans(distinct, num_cells)
    labels = np.empty(len(distinct), np.int64)
    palettes = []
    start = 0
    for number in range(num_cells):
        inside = np.flatnonzero(cell == number)
        # One entry for each cell, and the rest by the number of rows in it.
        num_entries = 1 + (size - num_cells) * len(inside) // len(distinct)
        palette, nearest = _run_kmeans(distinct[inside], num_entries)
        labels[inside] = start + nearest
        palettes.append(palette)
        start += len(palette)
    return np.concatenate(palettes), labels[numbers.reshape(-1)]


def _find_nearest(book: Float[ndarray, "m"], values: Float[ndarray, "*n"]) -> Int64[ndarray, "*n"]:
    """Find the entry of an ascending codebook that is nearest to each value."""
    # The border between two entries lies in their middle.
    return np.searchsorted((book[1:] + book[:-1]) / 2, values)


def _run_kmeans(
    rows: Float[ndarray, "n k"], count: int
) -> tuple[Float[ndarray, "m k"], Int32[ndarray, "n"]]:
    """Find centres by k-means, and the nearest to each row; OpenCV needs rows as vectors."""
    cv2.setRNGSeed(0)
    stop = (cv2.TERM_CRITERIA_MAX_ITER, CODEBOOK_ITERATIONS, 0.0)
    nearest = np.zeros(len(rows), np.int32)
    _, _, centres = cv2.kmeans(rows[:, None], count, nearest, stop, 1, cv2.KMEANS_PP_CENTERS)
    return np.asarray(centres), nearest
