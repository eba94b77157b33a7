"""Few values that stand for many: codebooks of numbers and palettes of rows, by k-means.

The first guess is evenly spaced, not random: the same values give the same codebook.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
from jaxtyping import Float, Int64, UInt8
from numpy import ndarray
from scipy.cluster.vq import kmeans2, vq

CODEBOOK_SIZE = 256
MIN_PALETTE_SIZE, MAX_PALETTE_SIZE = 1 << 12, 1 << 16
ROWS_PER_ENTRY = 4
"""Rows that share an entry of a palette between these sizes."""
SAMPLE_SIZE = 1 << 15
"""Values or rows to which a codebook or the cells are fitted."""
ITERATIONS = 5


def fit_codebook(
    values: Float[ndarray, "n k"],
) -> tuple[Float[ndarray, "256"], UInt8[ndarray, "n k"]]:
    """Fit 256 numbers to all values; return them in ascending order, and the nearest by number.

    Half of the guess are quantiles, half cover the range, so that rare values stay close too.
    """
    sample = _take_evenly(np.sort(values, axis=None), SAMPLE_SIZE)
    half = CODEBOOK_SIZE // 2
    covering = np.linspace(sample[0], sample[-1], half, dtype=np.float32)
    guess = np.concatenate([_take_evenly(sample, half), covering])
    book = np.sort(_run_kmeans(sample[:, None], guess[:, None])[:, 0])
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def fit_palette(
    rows: Float[ndarray, "n k"],
) -> tuple[Float[ndarray, "p k"], Int64[ndarray, "n"]]:
    """Fit up to 65,536 rows to rows, of which few are kept as they are; number the nearest.

    The space of rows is divided into as many cells as each has entries, which bounds the time.
    """
    distinct, numbers = np.unique(rows, axis=0, return_inverse=True)
    size = min(max(MIN_PALETTE_SIZE, len(rows) // ROWS_PER_ENTRY), MAX_PALETTE_SIZE)
    if len(distinct) <= size:
        return distinct, numbers.reshape(-1)
    num_cells = math.isqrt(size)
    sample = _take_evenly(distinct, SAMPLE_SIZE)
    cell, _ = vq(distinct, _run_kmeans(sample, _take_evenly(sample, num_cells)))
    labels, palettes, start = np.empty(len(distinct), np.int64), [], 0
    for inside in (np.flatnonzero(cell == number) for number in np.unique(cell)):
        share = 1 + (size - num_cells) * len(inside) // len(distinct)
        palette = _run_kmeans(distinct[inside], _take_evenly(distinct[inside], share))
        labels[inside] = start + vq(distinct[inside], palette)[0]
        palettes.append(palette)
        start += len(palette)
    return np.concatenate(palettes), labels[numbers.reshape(-1)]


def _take_evenly(rows: Float[ndarray, "n *k"], count: int) -> Float[ndarray, "m *k"]:
    """Take `count` rows at even distances, with the first and the last; of fewer, some twice."""
    return rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]


def _run_kmeans(rows: Float[ndarray, "n k"], guess: Float[ndarray, "m k"]) -> Float[ndarray, "m k"]:
    """Run k-means from a guess; a centre that no row is nearest to stays in its place."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return kmeans2(rows, guess, ITERATIONS, minit="matrix")[0]
