"""From posed photographs to Gaussians, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gscompleter.errors import InputError
from gscompleter.interpolation import fill_smoothly
from gscompleter.kernels import stereo
from gscompleter.reconstructors.plane_sweep.aggregation import AggregationConfig, aggregate
from gscompleter.reconstructors.plane_sweep.depth_range import estimate_depth_range
from gscompleter.reconstructors.plane_sweep.frames import frames_of, transform_between
from gscompleter.reconstructors.plane_sweep.gaussians import DiscConfig, discs, normals_of
from gscompleter.reconstructors.plane_sweep.matching import (
    MatchingConfig,
    cost_volume,
    inverse_depth_planes,
)
from gscompleter.types import DepthMap, Reconstruction, View, merge


@dataclass(frozen=True)
class PlaneSweep:
    """Plane-sweep stereo with semi-global aggregation, completed where nothing matches."""

    matching: MatchingConfig = MatchingConfig()
    """Planes and costs."""
    aggregation: AggregationConfig = AggregationConfig()
    """Penalties of the semi-global aggregation."""
    discs: DiscConfig = DiscConfig()
    """Sizes of the Gaussians."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        frames, unit = frames_of(views)
        near, far = depth_range(views)
        maps = []
        for i, frame in enumerate(frames):
            sources = [other for j, other in enumerate(frames) if j != i]
            planes = inverse_depth_planes(frame, sources, near / unit, far / unit, self.matching)
            costs = cost_volume(frame, sources, planes, self.matching)
            index, _ = stereo.winners(aggregate(costs, frame, self.aggregation))
            maps.append((planes[0] + index * (planes[1] - planes[0])).astype(np.float32))
        depths = []
        for i, frame in enumerate(frames):
            agree = np.zeros(frame.size, bool)
            for j, other in enumerate(frames):
                if i != j:
                    error, _ = stereo.reproject(
                        maps[i],
                        maps[j],
                        transform_between(frame, other),
                        transform_between(other, frame),
                    )
                    agree |= (error >= 0) & (error < 1.5)
            valid = torch.from_numpy(agree)
            inverse = torch.from_numpy(maps[i])
            filled = fill_smoothly(inverse, valid) if agree.any() else inverse
            depths.append(DepthMap(unit / filled, valid))
        parts = [
            discs(
                view,
                d.depth.to(view.image.device),
                normals_of(d.depth.to(view.image.device), view),
                torch.full_like(d.depth, self.discs.opacity).to(view.image.device),
                self.discs,
            )
            for view, d in zip(views, depths, strict=True)
        ]
        return Reconstruction(
            merge(parts),
            tuple(depths),
            torch.cat([torch.full((len(p),), i) for i, p in enumerate(parts)]),
            torch.cat([torch.arange(len(p)) for p in parts]),
        )


def depth_range(views: Sequence[View]) -> tuple[float, float]:
    """Near and far z-depth of `views`: as their cameras know it, else estimated."""
    near, far = views[0].camera.near, views[0].camera.far
    if near is None or far is None:
        low, high = estimate_depth_range(views)
        near, far = near if near is not None else low, far if far is not None else high
    if not 0 < near < far:
        raise InputError(
            f"The depth range {near:g} to {far:g} is empty; near must be positive and less "
            "than far."
        )
    return near, far
