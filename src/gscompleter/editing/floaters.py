"""Removal of floaters without photographs, by statistics of neighbouring Gaussians.

A Gaussian is compared with its nearest neighbours only. Far walls and the sky are sparse and large,
but so are their neighbours, and together they leave no gaps: they stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import FloaterConfig
from gscompleter.system.errors import InputError
from gscompleter.types import Gaussians

MAX_BREADTH = 10.0
"""Largest factor by which the limit of opacity rises with the size of a Gaussian."""
QUERIES = 250_000
"""Gaussians whose neighbours are measured at a time, to save memory."""


@dataclass(frozen=True)
class Surroundings:
    """Statistics of n Gaussians and their nearest neighbours."""

    sigmas: Float[Tensor, "n 3"]
    """Own standard deviations in descending order, in scene units."""
    sigma: Float[Tensor, "n"]
    """Median of the neighbours' largest standard deviations, in scene units."""
    distance: Float[Tensor, "n"]
    """Median distance to the neighbours, in scene units."""
    spacing: Float[Tensor, "n"]
    """Median of `distance` over the neighbours, at least that of the scene."""
    gap: Float[Tensor, "n"]
    """Median distance to the neighbours, relative to the sum of both largest deviations."""


def find_floaters(
    scene: Gaussians, config: FloaterConfig = FloaterConfig()
) -> dict[str, Bool[Tensor, "n"]]:
    """Find floaters by reason, again without those found until none is left; generated ones stay.

    A Gaussian may have several reasons. Floaters beside others show only after these are found.
    """
    if len(scene) <= config.neighbors:
        raise InputError(
            f"The scene has {len(scene)} Gaussians, too few to compare each with "
            f"{config.neighbors} neighbours; give its photographs."
        )
    # Nothing here depends on colours by direction, which are most of the memory of a scene.
    scene = replace(scene, sh=scene.sh[:, :1], encoded=None)
    masks: dict[str, Bool[Tensor, "n"]] = {}
    remaining = torch.arange(len(scene), device=scene.means.device)
    rest = scene
    while len(rest) > config.neighbors:
        is_floater_by_reason = rate_gaussians(rest, config)
        for reason, is_floater in is_floater_by_reason.items():
            none = torch.zeros_like(scene.generated, dtype=torch.bool)
            known = masks.get(reason, none)
            masks[reason] = known.index_fill(0, remaining[is_floater], True)
        gone = torch.stack(list(is_floater_by_reason.values())).any(dim=0)
        if not gone.any():
            break
        remaining = remaining[~gone]
        rest = rest[~gone]
    return masks


def rate_gaussians(scene: Gaussians, config: FloaterConfig) -> dict[str, Bool[Tensor, "n"]]:
    """Compare Gaussians with their surroundings, as `find_floaters` does in each round."""
    around = measure_surroundings(scene, config.neighbors)
    longest, middle, shortest = around.sigmas.unbind(dim=1)
    # All sizes and distances are relative to those of the neighbours: walls and the sky are far,
    # large and sparse, but all of their Gaussians are.
    size = longest / around.sigma
    remoteness = around.distance / around.spacing
    is_large = size > config.max_size
    is_detached = around.distance > config.max_size * around.sigma
    # The larger a Gaussian is beside its neighbours, the more opaque it has to be.
    min_opacity = config.min_opacity * (size / 2).clamp(1, MAX_BREADTH)
    reasons = {
        "isolated": around.gap > config.max_gap,
        "huge": (shortest > config.max_thickness * around.spacing)
        | (is_large & (remoteness > config.max_remoteness)),
        "needles": is_large & is_detached & (longest > config.max_elongation * middle),
        "transparent": scene.opacities < min_opacity,
    }
    return {reason: mask & (scene.generated == 0) for reason, mask in reasons.items()}


def measure_surroundings(scene: Gaussians, neighbors: int) -> Surroundings:
    """Measure each Gaussian and its nearest neighbours."""
    # Imported here, since SciPy is slow to import.
    from scipy.spatial import cKDTree

    means = scene.means.double().cpu().numpy()
    tree = cKDTree(means)
    sigmas = scene.scales.sort(dim=1, descending=True).values
    longest = sigmas[:, 0]
    sigma = torch.empty_like(longest)
    distance = torch.empty_like(longest)
    gap = torch.empty_like(longest)
    # The numbers of all neighbours are kept, in 32 bits, since `spacing` needs all distances. What
    # else is known of each neighbour is held for some Gaussians at a time.
    numbers = torch.empty(len(means), neighbors, dtype=torch.int32)
    for start in range(0, len(means), QUERIES):
        block = slice(start, start + QUERIES)
        found = tree.query(means[block], neighbors + 1, workers=torch.get_num_threads())
        # The first neighbour of a Gaussian is itself.
        apart, rows = (torch.from_numpy(values[:, 1:]).to(sigmas.device) for values in found)
        apart = apart.to(sigmas.dtype)
        numbers[block] = rows.cpu()
        sigma[block] = longest[rows].median(dim=1).values
        distance[block] = apart.median(dim=1).values
        reach = longest[block, None] + longest[rows]
        gap[block] = (apart / reach).median(dim=1).values

    spacing = torch.empty_like(longest)
    for start in range(0, len(means), QUERIES):
        block = slice(start, start + QUERIES)
        rows = numbers[block].long().to(sigmas.device)
        spacing[block] = distance[rows].median(dim=1).values
    # At least that of the scene, so that nothing is remote in its densest parts.
    return Surroundings(sigmas, sigma, distance, spacing.clamp_min(distance.median()), gap)
