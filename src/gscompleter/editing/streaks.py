"""Streaks: long Gaussians most of whose length has nothing beside it.

Splats of few or wrongly posed photographs are full of them. Beside its neighbours a streak among
hundreds is usual, so that streaks are measured against the scene. A long Gaussian is needed where
others lie along it, as at an edge or a string: the share of its length that passes through no other
Gaussian decides. What sticks out of an object by less than that is seen in twelve renders from
outside (decision 085).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter.config import FloaterConfig
from gscompleter.editing.cutting import GAUSSIAN_REACH
from gscompleter.editing.nearest import NearestGaussians
from gscompleter.numerics.geometry import quats_to_rotations
from gscompleter.render.outside import Extent, look_from_outside, measure_extent
from gscompleter.render.protocols import Renderer
from gscompleter.system.progress import track
from gscompleter.types import Gaussians

PLACES_ALONG = (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5)
"""Places along a Gaussian that are looked at, in its standard deviations."""
NUM_NEIGHBORS = 16
"""Gaussians around each of these places that may lie there."""
MIN_STREAK_OPACITY = 0.05
"""Least opacity of a Gaussian along which another one may lie."""
SUSPECT_SHARE = 0.3
"""Share of `max_free` from which on renders decide."""
STREAK_RENDER_SIDE = 128
"""Width and height of these renders, in pixels."""
STREAK_BLOCK = 5_000
"""Long Gaussians that are compared with their neighbours at a time, to save memory."""


@dataclass(frozen=True)
class LongGaussians:
    """The m long Gaussians of a scene."""

    rows: Int64[Tensor, "m"]
    """Their numbers in the scene."""
    places: Float[Tensor, "m t 3"]
    """Places along each at `PLACES_ALONG`, in the world."""
    width: Float[Tensor, "m"]
    """Second largest standard deviation, in scene units."""


def find_streaks(scene: Gaussians, config: FloaterConfig, renderer: Renderer) -> Bool[Tensor, "n"]:
    """Find the streaks of a scene, in rounds: what is found lies along no other Gaussian."""
    left = torch.ones_like(scene.generated, dtype=torch.bool)
    extent = measure_extent(scene)
    long = list_long_gaussians(scene, extent.radius, config)
    if len(long.rows) == 0:
        return ~left

    # The first one near a place is often the Gaussian that it belongs to.
    count = min(NUM_NEIGHBORS + 1, len(scene))
    places = long.places.flatten(0, 1)
    nearest = NearestGaussians(places, scene.means, count, "Looking along streaks")
    while True:
        free = measure_free_length(scene, long, nearest)
        is_streak = left[long.rows] & (free > config.max_free)
        gone = torch.zeros_like(left).index_fill(0, long.rows[is_streak], True)
        left &= ~gone
        if not gone.any() or left.sum() < count:
            break
        nearest.take_away(gone, left, left[long.rows].repeat_interleave(len(PLACES_ALONG)))

    suspects = long.rows[left[long.rows] & (free > SUSPECT_SHARE * config.max_free)]
    others = left.index_fill(0, suspects, False)
    if len(suspects) > 0 and others.any():
        uncovered = measure_uncovered(scene[others], scene[suspects], extent, renderer)
        left[suspects[uncovered > config.max_uncovered]] = False
    return ~left


def list_long_gaussians(scene: Gaussians, radius: float, config: FloaterConfig) -> LongGaussians:
    """List the Gaussians that are long for a scene of a radius; generated ones are left out."""
    scales, order = scene.scales.sort(dim=1, descending=True, stable=True)
    is_long = scales[:, 0] > config.min_length * radius
    is_long &= scales[:, 0] > config.min_slenderness * scales[:, 1]
    rows = (is_long & (scene.generated == 0)).nonzero()[:, 0]
    # The column of the rotation that belongs to the largest scale.
    columns = order[rows, :1, None].expand(-1, 3, 1)
    axes = quats_to_rotations(scene.quats[rows]).gather(2, columns)
    steps = torch.tensor(PLACES_ALONG).to(axes) * scales[rows, :1]
    places = scene.means[rows, None] + steps[..., None] * axes.mT
    return LongGaussians(rows, places, scales[rows, 1])


def measure_free_length(
    scene: Gaussians, long: LongGaussians, nearest: NearestGaussians
) -> Float[Tensor, "m"]:
    """Measure the share of long Gaussians, by their density, along which no other one lies."""
    steps = torch.tensor(PLACES_ALONG).to(scene.means)
    weights = (-(steps**2) / 2).softmax(dim=0)
    shares = [torch.zeros(0).to(weights)]
    for start in track(range(0, len(long.rows), STREAK_BLOCK), "Comparing streaks"):
        block = slice(start, start + STREAK_BLOCK)
        own = long.rows[block, None, None]
        numbers = nearest.rows[
            start * len(PLACES_ALONG) : (start + STREAK_BLOCK) * len(PLACES_ALONG)
        ]
        others = (
            torch.from_numpy(numbers).long().to(own.device).unflatten(0, (-1, len(PLACES_ALONG)))
        )
        # Offsets along the axes of the other one, in standard deviations of both together: across,
        # a long one is as wide as it is.
        offset = long.places[block, :, None] - scene.means[others]
        rotations = quats_to_rotations(scene.quats[others])
        along = (rotations.mT @ offset[..., None])[..., 0]
        variance = scene.scales[others] ** 2 + long.width[block, None, None, None] ** 2
        touches = (along**2 / variance.clamp_min(1e-30)).sum(dim=-1) < GAUSSIAN_REACH**2
        touches &= (others != own) & (scene.opacities[others] > MIN_STREAK_OPACITY)
        shares.append((~touches.any(dim=2)).to(weights) @ weights)
    return torch.cat(shares)


def measure_uncovered(
    others: Gaussians, suspects: Gaussians, extent: Extent, renderer: Renderer
) -> Float[Tensor, "m"]:
    """Measure the share of what suspects cover, seen from outside, where no others are."""
    beside = torch.zeros_like(suspects.opacities)
    total = torch.zeros_like(suspects.opacities)
    views = look_from_outside(others, renderer, STREAK_RENDER_SIDE, extent)
    for view in track(views, "Comparing renders"):
        empty = (~view.silhouette).to(beside)
        counted = torch.stack([empty, torch.ones_like(empty), torch.zeros_like(empty)], dim=-1)
        sums = renderer.freeze(suspects, view.camera).backproject(counted)
        beside += sums[:, 0]
        total += sums[:, 1]
    return beside / total.clamp_min(1e-12)
