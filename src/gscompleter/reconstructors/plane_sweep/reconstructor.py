"""From posed photographs to Gaussians, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations

import numpy as np
import torch
from jaxtyping import Float32

from gscompleter.kernels import stereo
from gscompleter.matching.depth_range import depth_range_of
from gscompleter.matching.features import features_of, matches
from gscompleter.matching.stereo_image import StereoImage, source_from_reference, stereo_images
from gscompleter.reconstructors.plane_sweep.aggregation import aggregate
from gscompleter.reconstructors.plane_sweep.appearance import fit_appearance
from gscompleter.reconstructors.plane_sweep.confidence import confidence_of, consistent
from gscompleter.reconstructors.plane_sweep.epipolar import rotated_to_matches
from gscompleter.reconstructors.plane_sweep.gaussians import discs, normals_of
from gscompleter.reconstructors.plane_sweep.matching import cost_volume, inverse_depth_planes
from gscompleter.reconstructors.plane_sweep.occlusion import Neighbour, hidden_from_others
from gscompleter.reconstructors.plane_sweep.surfaces import fit_surfaces
from gscompleter.render import Renderer, load_renderer
from gscompleter.types import DepthMap, Gaussians, Reconstruction, View, merge

Map = Float32[np.ndarray, "_ _"]
Transforms = dict[tuple[int, int], Float32[np.ndarray, "3 4"]]
"""`transforms[i, j]` is j_from_i: from the pixels of view i, at an inverse depth, to those of j."""
UNKNOWN = np.float32(1e-9)
"""Inverse depth of what a view is not sure of."""
BACKGROUND_WEIGHT = np.float32(0.3)
"""How much the background's depth counts where an object hides it from the other views."""


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

    disc_sigma: float = 0.6
    """Standard deviation of a Gaussian across the line of sight, in pixels."""
    renderer: Renderer = field(default_factory=lambda: load_renderer("cpu"))
    """Draws Gaussians while they are fitted."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Gaussians of all pixels of `views`, and their depths.

        Raises:
            InputError: fewer than two views, no baseline between them, an empty depth range.
        """
        near, far = depth_range_of(views)
        views = [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]
        depths = self.depths(views)
        parts = [self.splat(view, depth) for view, depth in zip(views, depths, strict=True)]
        device = views[0].image.device
        fitted = fit_appearance(
            merge(parts).to("cpu"), [view.to("cpu") for view in views], self.renderer
        )
        return Reconstruction(
            fitted.to(device),
            tuple(depths),
            torch.cat([torch.full((len(p),), i, device=device) for i, p in enumerate(parts)]),
            torch.cat([torch.arange(len(p), device=device) for p in parts]),
        )

    def depths(self, views: Sequence[View]) -> list[DepthMap]:
        """z-depth of all pixels of `views`, valid where it was measured, and how sure of it."""
        images, unit = stereo_images(views)
        near, far = depth_range_of(views)
        transforms = transforms_among(images)
        sweeps = [
            self.sweep(i, images, transforms, near / unit, far / unit) for i in range(len(images))
        ]
        confidences = self.confidences(sweeps, transforms)
        sure = [
            np.where(confidence > 0, sweep.inverse(sweep.index), UNKNOWN)
            for sweep, confidence in zip(sweeps, confidences, strict=True)
        ]
        depths = []
        for i, (view, sweep) in enumerate(zip(views, sweeps, strict=True)):
            measured, weight = self.with_background(i, sweep, confidences[i], sure, transforms)
            heights = fit_surfaces(measured, weight, images[i].image)
            depth = torch.from_numpy(np.float32(unit) / sweep.inverse(heights))
            confidence = torch.from_numpy(confidences[i]).to(view.image.device)
            depths.append(DepthMap(depth.to(confidence.device), confidence > 0, confidence))
        return depths

    def sweep(
        self,
        number: int,
        images: Sequence[StereoImage],
        transforms: Transforms,
        near: float,
        far: float,
    ) -> Sweep:
        """The planes that match best in view `number`."""
        image = images[number]
        sources = [(other, transforms[number, i]) for i, other in enumerate(images) if i != number]
        planes = inverse_depth_planes(image, sources, near, far)
        costs = cost_volume(image, sources, planes)
        index, margin = stereo.winners(aggregate(costs, image))
        return Sweep(planes, index, margin)

    def confidences(self, sweeps: Sequence[Sweep], transforms: Transforms) -> list[Map]:
        """How much each pixel's match counts: 0 where no other view agrees with it."""
        inverses = [sweep.inverse(sweep.index) for sweep in sweeps]
        agrees = [np.zeros(inverse.shape, bool) for inverse in inverses]
        for i, j in permutations(range(len(sweeps)), 2):
            j_from_i, i_from_j = transforms[i, j], transforms[j, i]
            agrees[i] |= consistent(inverses[i], inverses[j], j_from_i, i_from_j)
        return [
            confidence_of(sweep.index, sweep.margin, agree)
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
        occluded = (confidence == 0) & hidden_from_others(sweep.inverse(background), neighbours)
        weight = np.where(occluded, BACKGROUND_WEIGHT, confidence)
        return np.where(occluded, background, sweep.index), weight

    def splat(self, view: View, depth: DepthMap) -> Gaussians:
        """A disc for every pixel of `view`."""
        return discs(view, depth.depth, normals_of(depth.depth, view), self.disc_sigma)


def transforms_among(images: Sequence[StereoImage]) -> Transforms:
    """From every view to every other, through poses that agree with the matched features."""
    features = [features_of(image) for image in images]
    transforms = {}
    for i, j in combinations(range(len(images)), 2):
        pixels, matched = matches(features[i], features[j])
        rotated = rotated_to_matches(images[i], images[j], pixels, matched)
        transforms[i, j] = source_from_reference(images[i], rotated)
        transforms[j, i] = source_from_reference(rotated, images[i])
    return transforms
