"""How well each pixel matches the other views at each of a set of depth planes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

from gscompleter.kernels import stereo
from gscompleter.kernels.stereo import Bands
from gscompleter.matching.stereo_image import StereoImage

Source = tuple[StereoImage, Float[np.ndarray, "3 4"]]
"""Another view, and the transform to its pixels from those of the reference."""

STEP = 0.5
"""Pixels by which neighbouring planes move in the other image, at most pixels."""
MIN_PLANES, MAX_PLANES = 48, 256
"""Fewest and most planes."""
RADIUS = 2
"""Of the windows that are correlated, in pixels."""
NOISE = 0.015
"""Standard deviation of noise in colour; weaker texture correlates with nothing."""
DETAIL = 0.4
"""Share of the pixels' own difference in the cost; the rest is correlation of windows."""
UNSEEN_COST = 140
"""Cost (0 to 254) of a plane at which no other view sees the pixel."""


def inverse_depth_planes(
    reference: StereoImage, sources: Sequence[Source], near: float, far: float
) -> Float[np.ndarray, "d"]:
    """Inverse depths from far to near, evenly spaced, so that planes move by about STEP pixels.

    Planes so near that hardly any pixel stays within a source are left out: nothing matches there.
    """
    h, w = reference.size
    x, y = np.meshgrid(np.linspace(0.5, w - 0.5, 9), np.linspace(0.5, h - 0.5, 9))
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    samples = np.linspace(1 / far, 1 / near, 257)
    motion = np.zeros(256)
    overlap = np.zeros(257)
    for source, float_transform in sources:
        transform = float_transform.astype(np.float64)
        moved = (pixels @ transform[:, :3].T)[None] + samples[:, None, None] * transform[:, 3]
        ratio = moved[..., 2]
        at = moved[..., :2] / np.maximum(ratio, 1e-3)[..., None]
        H, W = source.size
        seen = (ratio > 1e-3) & (at >= 0).all(-1) & (at[..., 0] < W) & (at[..., 1] < H)
        steps = np.linalg.norm(np.diff(at, axis=0), axis=-1)
        motion = np.maximum(motion, quantiles(steps, seen[1:] & seen[:-1], 0.8))
        overlap = np.maximum(overlap, seen.mean(axis=1))
    useful = np.flatnonzero(overlap >= 0.02)
    last = max(int(useful[-1]), 8) if len(useful) else 256
    wanted = float(motion[:last].sum()) / STEP
    planes = int(np.clip(np.ceil(wanted), MIN_PLANES, MAX_PLANES))
    return np.linspace(samples[0], samples[last], planes).astype(np.float32)


def quantiles(
    values: Float[np.ndarray, "r c"], counted: Bool[np.ndarray, "r c"], share: float
) -> Float[np.ndarray, "r"]:
    """Of each row, the quantile of the values that are counted; 0 where none is."""
    ordered = np.sort(np.where(counted, values, np.inf), axis=1)
    ordered[~counted.any(axis=1)] = 0
    last = (counted.sum(axis=1) - 1).clip(0)
    below = np.floor(share * last).astype(int)
    above = np.minimum(below + 1, last)
    low, high = (np.take_along_axis(ordered, i[:, None], 1)[:, 0] for i in (below, above))
    return low + (share * last - below) * (high - low)


def matched_costs(
    reference: StereoImage,
    sources: Sequence[Source],
    inverse_depths: Float[np.ndarray, "d"],
    bands: Bands,
) -> UInt8[np.ndarray, "cells"]:
    """Costs in 0 to 254 of the planes that `bands` names; of several sources the best counts.

    A surface that is hidden from one of them costs there whatever hides it; a view that sees it
    decides.
    """
    settings = (RADIUS, np.float32(NOISE), np.float32(DETAIL))
    planes = (inverse_depths, bands)
    costs = [
        stereo.matching_costs(reference.image, source.image, transform, *planes, *settings)
        for source, transform in sources
    ]
    best = np.minimum.reduce(costs)
    return np.where(best == stereo.UNSEEN, np.uint8(UNSEEN_COST), best)
