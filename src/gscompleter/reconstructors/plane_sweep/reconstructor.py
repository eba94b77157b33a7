"""From posed photographs to Gaussians, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32

from gscompleter.errors import InputError
from gscompleter.interpolation import fill_smoothly
from gscompleter.kernels import stereo
from gscompleter.reconstructors.plane_sweep.aggregation import AggregationConfig, aggregate
from gscompleter.reconstructors.plane_sweep.depth_range import estimate_depth_range
from gscompleter.reconstructors.plane_sweep.frames import (
    Frame,
    frames_of,
    transform_between,
)
from gscompleter.reconstructors.plane_sweep.gaussians import DiscConfig, discs, normals_of
from gscompleter.reconstructors.plane_sweep.matching import (
    MatchingConfig,
    cost_volume,
    inverse_depth_planes,
)
from gscompleter.types import DepthMap, Gaussians, Reconstruction, View, merge


@dataclass(frozen=True)
class PlaneSweep:
    """Plane-sweep stereo with semi-global aggregation, completed where nothing matches."""

    matching: MatchingConfig = MatchingConfig()
    """Planes and costs."""
    aggregation: AggregationConfig = AggregationConfig()
    """Penalties of the semi-global aggregation."""
    discs: DiscConfig = DiscConfig()
    """Sizes of the Gaussians."""
    max_return_error: float = 1.5
    """Pixels by which a match may miss itself on the way to another view and back."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Gaussians of all pixels of `views`, and their depths.

        Raises:
            InputError: fewer than two views, no baseline between them, an empty depth range.
        """
        frames, unit = frames_of(views)
        near, far = depth_range(views)
        inverses = [self.sweep(i, frames, near / unit, far / unit) for i in range(len(frames))]
        depths = []
        for number, view in enumerate(views):
            valid = torch.from_numpy(agreeing(number, frames, inverses, self.max_return_error))
            inverse = torch.from_numpy(inverses[number])
            filled = fill_smoothly(inverse, valid) if valid.any() else inverse
            device = view.image.device
            depths.append(DepthMap((unit / filled).to(device), valid.to(device)))
        parts = [self.splat(view, depth) for view, depth in zip(views, depths, strict=True)]
        return Reconstruction(
            merge(parts),
            tuple(depths),
            torch.cat([torch.full((len(p),), i) for i, p in enumerate(parts)]),
            torch.cat([torch.arange(len(p)) for p in parts]),
        )

    def sweep(
        self, number: int, frames: Sequence[Frame], near: float, far: float
    ) -> Float32[np.ndarray, "h w"]:
        """Inverse depths of view `number`, by matching it with all others."""
        frame = frames[number]
        sources = [other for i, other in enumerate(frames) if i != number]
        planes = inverse_depth_planes(frame, sources, near, far, self.matching)
        costs = cost_volume(frame, sources, planes, self.matching)
        index, _ = stereo.winners(aggregate(costs, frame, self.aggregation))
        return (planes[0] + index * (planes[1] - planes[0])).astype(np.float32)

    def splat(self, view: View, depth: DepthMap) -> Gaussians:
        """A disc for every pixel of `view`."""
        opacity = torch.full_like(depth.depth, self.discs.opacity)
        return discs(view, depth.depth, normals_of(depth.depth, view), opacity, self.discs)


def agreeing(
    number: int,
    frames: Sequence[Frame],
    inverses: Sequence[Float32[np.ndarray, "_ _"]],
    max_return_error: float,
) -> Bool[np.ndarray, "h w"]:
    """Pixels of view `number` that some other view sees at the same depth."""
    agree = np.zeros(frames[number].size, bool)
    for other in range(len(frames)):
        if other != number:
            there = transform_between(frames[number], frames[other])
            back = transform_between(frames[other], frames[number])
            error, _ = stereo.reproject(inverses[number], inverses[other], there, back)
            agree |= (error >= 0) & (error < max_return_error)
    return agree


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
