"""From posed photographs to Gaussians, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations

import numpy as np
import torch
from jaxtyping import Float32

from gscompleter.errors import InputError
from gscompleter.kernels import stereo
from gscompleter.matching.depth_range import estimate_depth_range
from gscompleter.matching.features import features_of, matches
from gscompleter.matching.frames import Frame, frames_of, transform_between
from gscompleter.reconstructors.plane_sweep.aggregation import AggregationConfig, aggregate
from gscompleter.reconstructors.plane_sweep.appearance import AppearanceConfig, fit_appearance
from gscompleter.reconstructors.plane_sweep.confidence import (
    ConfidenceConfig,
    agreement,
    confidence_of,
)
from gscompleter.reconstructors.plane_sweep.epipolar import EpipolarConfig, turned_to_matches
from gscompleter.reconstructors.plane_sweep.gaussians import DiscConfig, discs, normals_of
from gscompleter.reconstructors.plane_sweep.matching import (
    MatchingConfig,
    cost_volume,
    inverse_depth_planes,
)
from gscompleter.reconstructors.plane_sweep.occlusion import Neighbour, hidden_from_others
from gscompleter.reconstructors.plane_sweep.surfaces import SurfaceConfig, fit_surfaces
from gscompleter.render import Renderer, load_renderer
from gscompleter.types import DepthMap, Gaussians, Reconstruction, View, merge

Map = Float32[np.ndarray, "_ _"]
Transforms = dict[tuple[int, int], Float32[np.ndarray, "3 4"]]
"""From the pixels of one view, at an inverse depth, to those of another, by their numbers."""
UNKNOWN = np.float32(1e-9)
"""Inverse depth of what a view is not sure of."""


@dataclass(frozen=True)
class Sweep:
    """What matching says of one view."""

    planes: Float32[np.ndarray, "d"]
    """Inverse depths from far to near, evenly spaced."""
    index: Map
    """The best plane of each pixel, to a fraction."""
    margin: Map
    """How much more the second best costs."""

    def inverse(self, index: Map) -> Map:
        """Inverse depths at fractions of planes, none farther than twice the farthest plane."""
        step = self.planes[1] - self.planes[0]
        within = index.clip(-0.5, len(self.planes) - 0.5)
        return np.maximum(self.planes[0] + within * step, self.planes[0] / 2).astype(np.float32)


@dataclass(frozen=True)
class PlaneSweep:
    """Plane-sweep stereo, completed by surfaces, splatted, and fitted to the photographs."""

    epipolar: EpipolarConfig = EpipolarConfig()
    """Small errors of the poses."""
    matching: MatchingConfig = MatchingConfig()
    """Planes and costs."""
    aggregation: AggregationConfig = AggregationConfig()
    """Penalties of the semi-global aggregation."""
    confidence: ConfidenceConfig = ConfidenceConfig()
    """Which matches count."""
    surfaces: SurfaceConfig = SurfaceConfig()
    """How depth is smoothed, and completed where nothing matches."""
    discs: DiscConfig = DiscConfig()
    """Sizes of the Gaussians."""
    appearance: AppearanceConfig = AppearanceConfig()
    """How opacities and colours are fitted."""
    renderer: Renderer = field(default_factory=lambda: load_renderer("cpu"))
    """Draws Gaussians while they are fitted."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Gaussians of all pixels of `views`, and their depths.

        Raises:
            InputError: fewer than two views, no baseline between them, an empty depth range.
        """
        near, far = depth_range(views)
        views = [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]
        depths = self.depths(views)
        parts = [self.splat(view, depth) for view, depth in zip(views, depths, strict=True)]
        device = views[0].image.device
        fitted = fit_appearance(
            merge(parts).to("cpu"),
            [view.to("cpu") for view in views],
            self.renderer,
            self.appearance,
        )
        return Reconstruction(
            fitted.to(device),
            tuple(depths),
            torch.cat([torch.full((len(p),), i) for i, p in enumerate(parts)]),
            torch.cat([torch.arange(len(p)) for p in parts]),
        )

    def depths(self, views: Sequence[View]) -> list[DepthMap]:
        """z-depth of all pixels of `views`, valid where it was measured, and how sure of it."""
        frames, unit = frames_of(views)
        near, far = depth_range(views)
        transforms = transforms_among(frames, self.epipolar)
        sweeps = [
            self.sweep(i, frames, transforms, near / unit, far / unit) for i in range(len(frames))
        ]
        confidences = self.confidences(sweeps, transforms)
        sure = [
            np.where(confidence > 0, sweep.inverse(sweep.index), UNKNOWN)
            for sweep, confidence in zip(sweeps, confidences, strict=True)
        ]
        depths = []
        for number, (view, frame, sweep) in enumerate(zip(views, frames, sweeps, strict=True)):
            measured, weight = self.with_background(
                number, sweep, confidences[number], sure, transforms
            )
            heights = fit_surfaces(measured, weight, frame.image, self.surfaces)
            depth = torch.from_numpy(np.float32(unit) / sweep.inverse(heights))
            confidence = torch.from_numpy(confidences[number])
            device = view.image.device
            depths.append(
                DepthMap(depth.to(device), (confidence > 0).to(device), confidence.to(device))
            )
        return depths

    def sweep(
        self,
        number: int,
        frames: Sequence[Frame],
        transforms: Transforms,
        near: float,
        far: float,
    ) -> Sweep:
        """The planes that match best in view `number`."""
        frame = frames[number]
        others = [i for i in range(len(frames)) if i != number]
        sources = [(frames[i], transforms[number, i]) for i in others]
        planes = inverse_depth_planes(frame, sources, near, far, self.matching)
        costs = cost_volume(frame, sources, planes, self.matching)
        index, margin = stereo.winners(aggregate(costs, frame, self.aggregation))
        return Sweep(planes, index, margin)

    def confidences(self, sweeps: Sequence[Sweep], transforms: Transforms) -> list[Map]:
        """How much each pixel's match counts: 0 where no other view agrees with it."""
        inverses = [sweep.inverse(sweep.index) for sweep in sweeps]
        agrees = [np.zeros(inverse.shape, bool) for inverse in inverses]
        for i, j in permutations(range(len(sweeps)), 2):
            there, back = transforms[i, j], transforms[j, i]
            agrees[i] |= agreement(inverses[i], inverses[j], there, back, self.confidence)
        return [
            confidence_of(sweep.index, sweep.margin, agree, self.confidence)
            for sweep, agree in zip(sweeps, agrees, strict=True)
        ]

    def with_background(
        self,
        number: int,
        sweep: Sweep,
        confidence: Map,
        sure: Sequence[Map],
        transforms: Transforms,
    ) -> tuple[Map, Map]:
        """The planes of view `number` and how much each counts, those of occluded pixels too.

        `sure` are the inverse depths of all views, next to 0 where a view is not sure of them.
        """
        background = stereo.background(sweep.index, confidence > 0)
        neighbours = [
            Neighbour(inverse, transforms[number, i], transforms[i, number])
            for i, inverse in enumerate(sure)
            if i != number
        ]
        occluded = (confidence == 0) & hidden_from_others(
            sweep.inverse(background), neighbours, self.confidence.max_return_error
        )
        weight = np.where(occluded, np.float32(self.confidence.of_background), confidence)
        return np.where(occluded, background, sweep.index), weight

    def splat(self, view: View, depth: DepthMap) -> Gaussians:
        """A disc for every pixel of `view`."""
        opacity = torch.full_like(depth.depth, self.discs.opacity)
        return discs(view, depth.depth, normals_of(depth.depth, view), opacity, self.discs)


def transforms_among(frames: Sequence[Frame], config: EpipolarConfig) -> Transforms:
    """From every view to every other, through poses that agree with the matched features."""
    features = [features_of(frame) for frame in frames]
    transforms = {}
    for i, j in combinations(range(len(frames)), 2):
        pixels, matched = matches(features[i], features[j])
        turned = turned_to_matches(frames[i], frames[j], pixels, matched, config)
        transforms[i, j] = transform_between(frames[i], turned)
        transforms[j, i] = transform_between(turned, frames[i])
    return transforms


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
