"""From posed photographs to Gaussians, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from gscompleter.kernels import stereo
from gscompleter.matching.depth_range import depth_range_of
from gscompleter.matching.neighbours import Neighbours, neighbours_among
from gscompleter.matching.stereo_image import StereoImage, source_from_reference, stereo_images
from gscompleter.reconstructors.plane_sweep.aggregation import aggregate
from gscompleter.reconstructors.plane_sweep.appearance import fit_appearance
from gscompleter.reconstructors.plane_sweep.confidence import Mask, confidence_of, consistent
from gscompleter.reconstructors.plane_sweep.epipolar import rotated_to_matches
from gscompleter.reconstructors.plane_sweep.fusion import (
    Layer,
    Transforms,
    finest_pixels,
    free_pixels,
)
from gscompleter.reconstructors.plane_sweep.gaussians import discs, normals_of
from gscompleter.reconstructors.plane_sweep.joint_fit import fit_jointly
from gscompleter.reconstructors.plane_sweep.matching import (
    Source,
    cost_volume,
    inverse_depth_planes,
)
from gscompleter.reconstructors.plane_sweep.occlusion import (
    UNKNOWN,
    Neighbour,
    hidden_from_others,
)
from gscompleter.reconstructors.plane_sweep.surfaces import fit_surfaces
from gscompleter.render import Renderer, load_renderer
from gscompleter.types import DepthMap, Gaussians, Reconstruction, View, merge

Map = Float32[np.ndarray, "_ _"]
HALVED_FROM = 192
"""Pixels of the shortest side from which images of many views are matched at half their size."""
MIN_ALPHA = 0.7
"""Alpha below which a surface that no view was to show is shown by the view that meets the gap."""
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
class Rig:
    """How the views stand to each other."""

    images: list[StereoImage]
    unit: float
    """The widest baseline, in scene units; lengths of stereo are multiples of it."""
    neighbours: Neighbours
    transforms: Transforms

    @property
    def is_halved(self) -> bool:
        """Whether images of half the size are matched."""
        smallest = min(min(image.size) for image in self.images)
        return len(self.images) > 2 and smallest >= HALVED_FROM


@dataclass(frozen=True)
class PlaneSweep:
    """Plane-sweep stereo, completed by surfaces, splatted, and fitted to the photographs."""

    disc_sigma: float = 0.6
    """Standard deviation of a Gaussian across the line of sight, in pixels."""
    renderer: Renderer = field(default_factory=lambda: load_renderer("cpu"))
    """Draws Gaussians while they are fitted."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Gaussians of what `views` show, and the depths of all of their pixels.

        Two views keep all of their pixels. Of more views each surface is kept once, by the view
        that sees it best, and nothing where another view sees through it.

        Raises:
            InputError: fewer than two views, no baseline between them, an empty depth range.
        """
        near, far = depth_range_of(views)
        views = [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]
        rig = rig_of(views)
        layers = self.layers(rig, near, far)
        depths = depth_maps(layers, rig.unit, views)
        parts = [self.splat(view, depth) for view, depth in zip(views, depths, strict=True)]
        every, on_cpu = merge(parts).to("cpu"), [view.to("cpu") for view in views]
        chosen = self.chosen(every, on_cpu, layers, rig.transforms)
        fit = fit_appearance if len(views) == 2 else fit_jointly
        fitted = fit(every[chosen], on_cpu, self.renderer)
        device = views[0].image.device
        rows = [torch.arange(len(part)) for part in parts]
        numbers = [torch.full((len(part),), i) for i, part in enumerate(parts)]
        return Reconstruction(
            fitted.to(device),
            tuple(depths),
            torch.cat(numbers)[chosen].to(device),
            torch.cat(rows)[chosen].to(device),
        )

    def depths(self, views: Sequence[View]) -> list[DepthMap]:
        """z-depth of all pixels of `views`, valid where it was measured, and how sure of it."""
        rig = rig_of(views)
        return depth_maps(self.layers(rig, *depth_range_of(views)), rig.unit, views)

    def layers(self, rig: Rig, near: float, far: float) -> list[Layer]:
        """What stereo says of each view; `near` and `far` are z-depths in scene units."""
        sweeps = [
            self.sweep(i, rig, near / rig.unit, far / rig.unit) for i in range(len(rig.images))
        ]
        confidences = self.confidences(sweeps, rig)
        sure = [
            np.where(confidence > 0, sweep.inverse(sweep.index), UNKNOWN)
            for sweep, confidence in zip(sweeps, confidences, strict=True)
        ]
        layers = []
        for i, (sweep, confidence) in enumerate(zip(sweeps, confidences, strict=True)):
            measured, weight = self.with_background(i, sweep, confidence, sure, rig)
            heights = fit_surfaces(measured, weight, rig.images[i].image)
            layers.append(Layer(rig.images[i], sweep.inverse(heights), confidence))
        return layers

    def sweep(self, number: int, rig: Rig, near: float, far: float) -> Sweep:
        """The planes that match best in view `number`.

        Of more views than two, unless they are small, images of half the size are matched: surfaces
        and the joint fit find what that leaves out, in an eighth of the time.
        """
        image, chosen = rig.images[number], rig.neighbours.of[number]
        sources = [(rig.images[i], rig.transforms[number, i]) for i in chosen]
        if not rig.is_halved:
            return swept(image, sources, near, far)
        half = [(halved(other), at_half_size(transform)) for other, transform in sources]
        coarse = swept(halved(image), half, near, far)
        index, margin = (doubled(values, image.size) for values in (coarse.index, coarse.margin))
        return replace(coarse, index=index, margin=margin)

    def confidences(self, sweeps: Sequence[Sweep], rig: Rig) -> list[Map]:
        """How much each pixel's match counts: 0 where no other view agrees with it."""
        inverses = [sweep.inverse(sweep.index) for sweep in sweeps]
        confidences = []
        for i, sweep in enumerate(sweeps):
            agrees = np.zeros(inverses[i].shape, bool)
            for j in rig.neighbours.either_way(i):
                there, back = rig.transforms[i, j], rig.transforms[j, i]
                agrees |= consistent(inverses[i], inverses[j], there, back)
            confidences.append(confidence_of(sweep.index, sweep.margin, agrees))
        return confidences

    def chosen(
        self,
        every: Gaussians,
        views: Sequence[View],
        layers: Sequence[Layer],
        transforms: Transforms,
    ) -> Bool[Tensor, "n"]:
        """Which of the Gaussians of all pixels make the scene."""
        if len(views) == 2:
            return torch.ones(len(every), dtype=torch.bool)
        free = free_pixels(layers, transforms)
        kept = as_rows(finest_pixels(layers, free, transforms))
        start = 0
        for view, mask in zip(views, free, strict=True):
            alpha = self.renderer.render(every[kept], view.camera).alpha
            gap = torch.from_numpy(mask) & (alpha < MIN_ALPHA)
            kept[start : start + gap.numel()] |= gap.reshape(-1)
            start += gap.numel()
        return kept

    def with_background(
        self,
        number: int,
        sweep: Sweep,
        confidence: Map,
        sure: Sequence[Map],
        rig: Rig,
    ) -> tuple[Map, Map]:
        """The planes of view `number` and how much each counts, those of occluded pixels too.

        `sure` are the inverse depths of all views, next to 0 where a view is not sure of them.
        """
        background = stereo.background(sweep.index, confidence > 0)
        neighbours = [
            Neighbour(sure[i], rig.transforms[number, i], rig.transforms[i, number])
            for i in rig.neighbours.either_way(number)
        ]
        occluded = (confidence == 0) & hidden_from_others(sweep.inverse(background), neighbours)
        weight = np.where(occluded, BACKGROUND_WEIGHT, confidence)
        return np.where(occluded, background, sweep.index), weight

    def splat(self, view: View, depth: DepthMap) -> Gaussians:
        """A disc for every pixel of `view`."""
        return discs(view, depth.depth, normals_of(depth.depth, view), self.disc_sigma)


def swept(image: StereoImage, sources: Sequence[Source], near: float, far: float) -> Sweep:
    """The planes that match best in `image`, between depths in widest baselines."""
    planes = inverse_depth_planes(image, sources, near, far)
    costs = cost_volume(image, sources, planes)
    index, margin = stereo.winners(aggregate(costs, image))
    return Sweep(planes, index, margin)


def halved(image: StereoImage) -> StereoImage:
    """An image of half the size; the last row or column of an odd one is doubled before."""
    h, w = image.size
    even = np.pad(image.image, ((0, h % 2), (0, w % 2), (0, 0)), mode="edge")
    pixels = even.reshape((h + 1) // 2, 2, (w + 1) // 2, 2, 3).mean(axis=(1, 3))
    K = image.K * np.array([[0.5], [0.5], [1.0]])
    return replace(image, image=pixels.astype(np.float32), K=K)


def at_half_size(transform: Float32[np.ndarray, "3 4"]) -> Float32[np.ndarray, "3 4"]:
    """A transform between the pixels of two views, once both are halved."""
    half, twice = np.diag([0.5, 0.5, 1.0]), np.diag([2.0, 2.0, 1.0, 1.0])
    return (half @ transform @ twice).astype(np.float32)


def doubled(values: Map, size: tuple[int, int]) -> Map:
    """Each value four times, cut to `size`."""
    return np.ascontiguousarray(values.repeat(2, axis=0).repeat(2, axis=1)[: size[0], : size[1]])


def rig_of(views: Sequence[View]) -> Rig:
    """Where `views` stand, through poses that agree with the matched features.

    Raises:
        InputError: fewer than two views, no baseline between them.
    """
    images, unit = stereo_images(views)
    neighbours = neighbours_among(images)
    transforms = {}
    for i, j in combinations(range(len(images)), 2):
        source = images[j]
        if (i, j) in neighbours.matches:
            source = rotated_to_matches(images[i], source, *neighbours.matches[i, j])
        transforms[i, j] = source_from_reference(images[i], source)
        transforms[j, i] = source_from_reference(source, images[i])
    return Rig(images, unit, neighbours, transforms)


def depth_maps(layers: Sequence[Layer], unit: float, views: Sequence[View]) -> list[DepthMap]:
    """z-depths in scene units, on the device of the views."""
    depths = []
    for layer, view in zip(layers, views, strict=True):
        depth = torch.from_numpy(np.float32(unit) / layer.inverse)
        confidence = torch.from_numpy(layer.confidence).to(view.image.device)
        depths.append(DepthMap(depth.to(confidence.device), confidence > 0, confidence))
    return depths


def as_rows(masks: Sequence[Mask]) -> Bool[Tensor, "n"]:
    """Masks of the views one after the other, row by row."""
    return torch.cat([torch.from_numpy(mask).reshape(-1) for mask in masks])
