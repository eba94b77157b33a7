"""How well each pixel matches the other views at each of a set of depth planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from gscompleter.kernels import stereo
from gscompleter.matching.frames import Frame

Source = tuple[Frame, Float[np.ndarray, "3 4"]]
"""Another view, and the transform to its pixels from those of the reference."""


@dataclass(frozen=True)
class MatchingConfig:
    step: float = 0.5
    """Pixels by which neighbouring planes move in the other image, at most pixels."""
    min_planes: int = 48
    """Fewest planes."""
    max_planes: int = 256
    """Most planes."""
    radius: int = 2
    """Of the windows that are correlated, in pixels."""
    noise: float = 0.015
    """Standard deviation of noise in colour; weaker texture correlates with nothing."""
    detail: float = 0.4
    """Share of the pixels' own difference in the cost; the rest is correlation of windows."""
    best_share: float = 0.5
    """Share of the sources, the best ones, whose mean cost counts."""
    unseen_cost: int = 140
    """Cost (0 to 254) of a plane at which no other view sees the pixel."""


def inverse_depth_planes(
    reference: Frame, sources: Sequence[Source], near: float, far: float, config: MatchingConfig
) -> Float[np.ndarray, "d"]:
    """Inverse depths from far to near, evenly spaced, so that planes move by about `step` pixels.

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
        for k in range(256):
            both = seen[k] & seen[k + 1]
            if both.any():
                motion[k] = max(motion[k], float(np.quantile(steps[k, both], 0.8)))
        overlap = np.maximum(overlap, seen.mean(axis=1))
    useful = np.flatnonzero(overlap >= 0.02)
    last = max(int(useful[-1]), 8) if len(useful) else 256
    wanted = float(motion[:last].sum()) / config.step
    planes = int(np.clip(np.ceil(wanted), config.min_planes, config.max_planes))
    return np.linspace(samples[0], samples[last], planes).astype(np.float32)


def cost_volume(
    reference: Frame,
    sources: Sequence[Source],
    inverse_depths: Float[np.ndarray, "d"],
    config: MatchingConfig,
) -> UInt8[np.ndarray, "h w d"]:
    """Costs of the planes in 0 to 254; of several sources the best ones count."""
    costs = [
        stereo.matching_costs(
            reference.image,
            source.image,
            transform,
            inverse_depths,
            config.radius,
            np.float32(config.noise),
            np.float32(config.detail),
        )
        for source, transform in sources
    ]
    return stereo.best_mean(np.stack(costs), config.best_share, np.uint8(config.unseen_cost))
