"""Matching costs of each pixel against the other views, at a set of depth planes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

from gscompleter.kernels import stereo
from gscompleter.kernels.stereo import Bands
from gscompleter.reconstructors.features.stereo_image import StereoImage

Source = tuple[StereoImage, Float[np.ndarray, "3 4"]]
"""Another view, and the transform from reference pixels to its pixels."""

MAX_PLANE_MOTION = 0.5
"""Largest image motion between neighbouring planes, in pixels."""
MIN_PLANES, MAX_PLANES = 48, 256
"""Smallest and largest number of planes."""
RADIUS = 2
"""Radius of the correlation window, in pixels."""
NOISE = 0.015
"""Standard deviation of the image noise; weaker texture does not correlate."""
PIXEL_WEIGHT = 0.4
"""Weight of the per-pixel difference in the cost; the rest is window correlation."""
UNSEEN_COST = 140
"""Cost, from 0 to 254, of a plane at which no other view observes the pixel."""


def place_planes(
    reference: StereoImage, sources: Sequence[Source], near: float, far: float
) -> Float[np.ndarray, "d"]:
    """Space inverse depths evenly from far to near, without planes outside all sources."""
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
        motion = np.maximum(motion, compute_quantiles(steps, seen[1:] & seen[:-1], 0.8))
        overlap = np.maximum(overlap, seen.mean(axis=1))
    useful = np.flatnonzero(overlap >= 0.02)
    last = max(int(useful[-1]), 8) if len(useful) else 256
    wanted = float(motion[:last].sum()) / MAX_PLANE_MOTION
    planes = int(np.clip(np.ceil(wanted), MIN_PLANES, MAX_PLANES))
    return np.linspace(samples[0], samples[last], planes).astype(np.float32)


def compute_quantiles(
    values: Float[np.ndarray, "r c"], valid: Bool[np.ndarray, "r c"], share: float
) -> Float[np.ndarray, "r"]:
    """Compute a quantile of the `valid` values of each row; 0 for rows without any."""
    ordered = np.sort(np.where(valid, values, np.inf), axis=1)
    ordered[~valid.any(axis=1)] = 0
    last = (valid.sum(axis=1) - 1).clip(0)
    below = np.floor(share * last).astype(int)
    above = np.minimum(below + 1, last)
    low, high = (np.take_along_axis(ordered, i[:, None], 1)[:, 0] for i in (below, above))
    return low + (share * last - below) * (high - low)


def compute_costs(
    reference: StereoImage,
    sources: Sequence[Source],
    inverse_depths: Float[np.ndarray, "d"],
    bands: Bands,
) -> UInt8[np.ndarray, "cells"]:
    """Compute costs (0 to 254) of the planes in `bands`; the best source view counts."""
    settings = (RADIUS, np.float32(NOISE), np.float32(PIXEL_WEIGHT))
    planes = (inverse_depths, bands)
    costs = [
        stereo.compute_matching_costs(reference.image, source.image, transform, *planes, *settings)
        for source, transform in sources
    ]
    best = np.minimum.reduce(costs)
    return np.where(best == stereo.UNSEEN, np.uint8(UNSEEN_COST), best)
