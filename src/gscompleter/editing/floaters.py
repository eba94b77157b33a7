"""Removal of floaters without photographs, by statistics of Gaussians and renders from outside.

A Gaussian is compared with its nearest neighbours. Far walls and the sky are sparse and large, but
so are their neighbours, and together they leave no gaps: they stay. Streaks are measured absolutely
as well, against the scene (`streaks.py`), because the neighbours of a streak among hundreds are
streaks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter.config import FloaterConfig
from gscompleter.editing.nearest import NearestGaussians
from gscompleter.editing.streaks import find_streaks
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.system.errors import InputError
from gscompleter.system.progress import track
from gscompleter.types import Gaussians

MAX_BREADTH = 10.0
"""Largest factor by which the limit of opacity rises with the size of a Gaussian."""
FLOATER_BLOCK = 25_000
"""Gaussians whose neighbours are measured at a time, to save memory."""
NEIGHBOR_SEARCH = "Searching for neighbours"


class Surroundings:
    """Statistics of the nearest neighbours of each of n Gaussians.

    When Gaussians are taken away, only those that had one of them near are measured again.
    """

    def __init__(self, scene: Gaussians, neighbors: int) -> None:
        """Search for the neighbours, and measure them."""
        self._means = scene.means
        self._longest = scene.scales.max(dim=1).values
        # One more, because a Gaussian is among its own nearest.
        self._nearest = NearestGaussians(scene.means, scene.means, neighbors + 1, NEIGHBOR_SEARCH)
        self.sigma = torch.empty_like(self._longest)
        """Median of the neighbours' largest standard deviations, in scene units."""
        self.distance = torch.empty_like(self._longest)
        """Median distance to the neighbours, in scene units."""
        self.gap = torch.empty_like(self._longest)
        """Median distance to the neighbours, relative to the sum of both largest deviations."""
        self._measure(torch.arange(len(scene)).to(scene.means.device))

    def take_away(self, gone: Bool[Tensor, "n"], left: Bool[Tensor, "n"]) -> None:
        """Take the Gaussians in `gone` away from the neighbours of those in `left`."""
        lost = self._nearest.take_away(gone, left, asked=left)
        self._measure(torch.from_numpy(lost).to(left.device))

    def measure_spacing(self, rows: Int64[Tensor, "m"]) -> Float[Tensor, "m"]:
        """Measure the median of `distance` over the neighbours, at least that of all `rows`."""
        parts = [self.distance[self._list_neighbors(part)] for part in rows.split(FLOATER_BLOCK)]
        spacing = torch.cat([part.median(dim=1).values for part in parts])
        # At least that of the scene, so that nothing is remote in its densest parts.
        return spacing.clamp_min(self.distance[rows].median())

    def _measure(self, rows: Int64[Tensor, "m"]) -> None:
        """Measure the statistics of some Gaussians, in place."""
        for part in track(rows.split(FLOATER_BLOCK), "Comparing neighbours"):
            others = self._list_neighbors(part)
            offsets = self._means[part, None].double() - self._means[others].double()
            apart = offsets.norm(dim=2).to(self.distance.dtype)
            longest = self._longest[others]
            reach = self._longest[part, None] + longest
            self.sigma[part] = longest.median(dim=1).values
            self.distance[part] = apart.median(dim=1).values
            self.gap[part] = (apart / reach).median(dim=1).values

    def _list_neighbors(self, rows: Int64[Tensor, "m"]) -> Int64[Tensor, "m k"]:
        """List the numbers of the neighbours, in no order that counts."""
        asked = rows.cpu().numpy()
        numbers = self._nearest.rows[asked]
        # The first is the Gaussian itself; of several in one place it may be another one, which
        # then takes the place of the Gaussian among the rest.
        others = np.where(numbers[:, 1:] == asked[:, None], numbers[:, :1], numbers[:, 1:])
        return torch.from_numpy(others).long().to(rows.device)


def find_floaters(
    scene: Gaussians,
    config: FloaterConfig = FloaterConfig(),
    renderer: Renderer | None = None,
) -> dict[str, Bool[Tensor, "n"]]:
    """Find floaters by reason, again without those found until none is left; generated ones stay.

    A Gaussian may have several reasons. Floaters beside others show only after these are found, and
    streaks are searched for among what is then left.
    `renderer` is by default that of the scene's device.
    """
    if len(scene) <= config.neighbors:
        raise InputError(
            f"The scene has {len(scene)} Gaussians, too few to compare each with "
            f"{config.neighbors} neighbours; give its photographs."
        )
    # Nothing here depends on colours by direction, which are most of the memory of a scene.
    scene = replace(scene, sh=scene.sh[:, :1], encoded=None)
    left = torch.ones_like(scene.generated, dtype=torch.bool)
    masks: dict[str, Bool[Tensor, "n"]] = {}

    def take_out(found: dict[str, Bool[Tensor, "n"]]) -> Bool[Tensor, "n"]:
        """Take what was found out of those that are left, and return which these are."""
        gone = torch.stack(list(found.values())).any(dim=0)
        for reason, mask in found.items():
            masks[reason] = masks.get(reason, torch.zeros_like(mask)) | mask
        left.masked_fill_(gone, False)
        return gone

    around = Surroundings(scene, config.neighbors)
    while True:
        gone = take_out(rate_gaussians(scene, left, around, config))
        if not gone.any() or left.sum() <= config.neighbors:
            break
        around.take_away(gone, left)
    del around  # about 100 bytes a Gaussian

    masks["streaks"] = torch.zeros_like(left)
    if left.sum() > config.neighbors:
        renderer = renderer or load_renderer("cuda" if scene.means.is_cuda else "cpu")
        is_streak = find_streaks(scene[left], config, renderer)
        take_out({"streaks": torch.zeros_like(left).masked_scatter(left, is_streak)})
    return masks


def rate_gaussians(
    scene: Gaussians, left: Bool[Tensor, "n"], around: Surroundings, config: FloaterConfig
) -> dict[str, Bool[Tensor, "n"]]:
    """Compare the Gaussians that are left with their surroundings, as each round does."""
    rows = left.nonzero()[:, 0]
    longest, middle, shortest = scene.scales[rows].sort(dim=1, descending=True).values.unbind(dim=1)
    sigma = around.sigma[rows]
    distance = around.distance[rows]
    spacing = around.measure_spacing(rows)
    # All sizes and distances are relative to those of the neighbours: walls and the sky are far,
    # large and sparse, but all of their Gaussians are.
    size = longest / sigma
    is_large = size > config.max_size
    is_detached = distance > config.max_size * sigma
    # The larger a Gaussian is beside its neighbours, the more opaque it has to be.
    min_opacity = config.min_opacity * (size / 2).clamp(1, MAX_BREADTH)
    reasons = {
        "isolated": around.gap[rows] > config.max_gap,
        "huge": (shortest > config.max_thickness * spacing)
        | (is_large & (distance / spacing > config.max_remoteness)),
        "needles": is_large & is_detached & (longest > config.max_elongation * middle),
        "transparent": scene.opacities[rows] < min_opacity,
    }
    none = torch.zeros_like(left)
    return {
        reason: none.index_put((rows,), mask & (scene.generated[rows] == 0))
        for reason, mask in reasons.items()
    }
