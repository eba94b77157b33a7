"""Fill a hole with patches of the photographs, coarse to fine (Wexler et al., Space-Time Video
Completion, 2007; Barnes et al., PatchMatch, 2009; Darabi et al., Image Melding, 2012)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gscompleter.generators.warp_inpaint.smooth import push_pull
from gscompleter.kernels import patchmatch


@dataclass(frozen=True)
class ExemplarConfig:
    radius: int = 3
    """Patches are squares of 2 * radius + 1 pixels."""
    max_bias: float = 0.1
    """Largest shift of a patch's colour channel, in units of the colour."""
    bias_penalty: float = 0.3
    """Cost of a squared shift, relative to a squared difference of colour."""
    depth_penalty: float = 0.02
    """Cost of taking from a surface before the expected depth, per squared log-depth."""
    distance_penalty: float = 0.002
    """Cost of taking from the other end of the image."""
    iterations: tuple[int, int] = (2, 6)
    """Rounds of search and vote on the finest level and on the coarsest."""
    confidence: float = 0.85
    """Factor of the weight of an unknown pixel per pixel from the border of the hole."""
    min_size: int = 24
    """Shorter side, in pixels, under which the pyramid stops."""


@dataclass(frozen=True)
class Sources:
    """Images to take patches from, padded to one size."""

    images: Float[Tensor, "s h w 3"]
    valid: Bool[Tensor, "s h w"]
    log_depth: Float[Tensor, "s h w"]


@dataclass(frozen=True)
class _Level:
    image: Float[Tensor, "h w 3"]
    known: Bool[Tensor, "h w"]
    expected: Float[Tensor, "h w"]
    sources: Sources


def fill_by_patches(
    image: Float[Tensor, "h w 3"],
    known: Bool[Tensor, "h w"],
    expected_log_depth: Float[Tensor, "h w"],
    sources: Sources,
    seed: int,
    config: ExemplarConfig = ExemplarConfig(),
) -> Float[Tensor, "h w 3"]:
    """`image` with what is not `known` made of patches of `sources`."""
    levels = _pyramid(_Level(image, known, expected_log_depth, sources), config)
    filled = push_pull(levels[-1].image, levels[-1].known.float())
    field: Int64[ndarray, "h w 3"] | None = None
    for number, level in reversed(list(enumerate(levels))):
        if number < len(levels) - 1:
            filled = None
        share = number / max(len(levels) - 1, 1)
        first, last = config.iterations
        rounds = round(first + (last - first) * share)
        filled, field = _solve(level, filled, field, rounds, seed + 7919 * number, config)
    return filled


def _solve(level, filled, field, rounds, seed, config):
    h, w = level.known.shape
    radius = config.radius
    usable = _usable(level.sources.valid, radius)
    known = level.known.numpy()
    near_hole = cv2.dilate((~known).astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
    if not usable.any() or not near_hole.any():
        return (push_pull(level.image, level.known.float()) if filled is None else filled), field
    queries = np.argwhere(near_hole)
    query_at = np.full((h, w), -1, np.int64)
    query_at[near_hole] = np.arange(len(queries))
    hole = np.argwhere(~known)
    away = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5)
    weight = np.where(known, 1.0, np.maximum(config.confidence**away, 0.05)).astype(np.float32)
    matches = _initial_field(queries, field, usable, seed)
    images = np.ascontiguousarray(level.sources.images.numpy())
    log_depth = np.ascontiguousarray(level.sources.log_depth.numpy())
    expected = level.expected.numpy()[near_hole]
    current = level.image.numpy().copy()
    trust = weight[near_hole]
    if filled is None:
        shift = np.zeros((len(queries), 3), np.float32)
        colours, _ = patchmatch.vote((h, w), hole, query_at, trust, images, matches, shift, radius)
        current[~known] = colours
    else:
        current[~known] = filled.numpy()[~known]
    for k in range(rounds):
        cost, shift = patchmatch.search(
            current,
            weight,
            queries,
            query_at,
            expected,
            images,
            usable,
            log_depth,
            matches,
            radius,
            np.float32(config.max_bias),
            np.float32(config.bias_penalty),
            np.float32(config.depth_penalty),
            np.float32(config.distance_penalty),
            2,
            seed + 31 * k,
        )
        sigma = np.float32(max(np.percentile(cost, 75), 1e-6))
        votes = trust * np.exp(-cost / (2 * sigma))
        colours, totals = patchmatch.vote(
            (h, w), hole, query_at, votes.astype(np.float32), images, matches, shift, radius
        )
        current[~known] = colours
    dense = np.zeros((h, w, 3), np.int64)
    dense[near_hole] = matches
    dense[~near_hole] = -1
    return torch.from_numpy(current), dense


def _initial_field(queries, coarse, usable, seed):
    rng = np.random.default_rng(seed)
    centres = np.argwhere(usable)
    matches = centres[rng.integers(len(centres), size=len(queries))]
    if coarse is not None:
        h, w = coarse.shape[:2]
        above = coarse[np.minimum(queries[:, 0] // 2, h - 1), np.minimum(queries[:, 1] // 2, w - 1)]
        guess = above.copy()
        guess[:, 1:] = above[:, 1:] * 2 + queries % 2
        H, W = usable.shape[1:]
        ok = (above[:, 0] >= 0) & (guess[:, 1] < H) & (guess[:, 2] < W)
        guess[~ok] = 0
        ok &= usable[guess[:, 0], guess[:, 1], guess[:, 2]]
        matches[ok] = guess[ok]
    return np.ascontiguousarray(matches)


def _usable(valid, radius):
    out = np.zeros(valid.shape, bool)
    kernel = np.ones((2 * radius + 1,) * 2, np.uint8)
    for k, v in enumerate(valid.numpy().astype(np.uint8)):
        out[k] = cv2.erode(v, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    return out


def _pyramid(level, config):
    levels = [level]
    while True:
        last = levels[-1]
        hole = (~last.known).numpy().astype(np.uint8)
        size = min(last.known.shape)
        if size // 2 < config.min_size:
            break
        levels.append(_halve(last))
    return levels


def _halve(level):
    k = level.known.float()
    image, weight = _pool(level.image * k[..., None]), _pool(k[..., None])
    expected = _pool(level.expected[..., None])[..., 0]
    s = level.sources
    v = s.valid.float()[..., None]
    sw = _pool(v)
    images = _pool(s.images * v) / sw.clamp_min(1e-6)
    depth = _pool(s.log_depth[..., None] * v) / sw.clamp_min(1e-6)
    sources = Sources(images, sw[..., 0] > 0.75, depth[..., 0])
    return _Level(image / weight.clamp_min(1e-6), weight[..., 0] > 0.5, expected, sources)


def _pool(values):
    batch = values if values.ndim == 4 else values[None]
    out = avg_pool2d(batch.permute(0, 3, 1, 2), 2, ceil_mode=True, count_include_pad=False)
    out = out.permute(0, 2, 3, 1)
    return (out if values.ndim == 4 else out[0]).contiguous()
