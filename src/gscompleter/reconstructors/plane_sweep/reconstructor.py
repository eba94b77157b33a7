"""From posed photographs to Gaussians, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.kernels.sharing import side_by_side
from gscompleter.matching.depth_range import depth_range_of
from gscompleter.matching.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.appearance import fit_appearance, fit_colours
from gscompleter.reconstructors.plane_sweep.confidence import Mask
from gscompleter.reconstructors.plane_sweep.exposure import gains_of
from gscompleter.reconstructors.plane_sweep.fusion import (
    Layer,
    Transforms,
    finest_pixels,
    free_pixels,
)
from gscompleter.reconstructors.plane_sweep.gaussians import discs, normals_of
from gscompleter.reconstructors.plane_sweep.joint_fit import fit_jointly
from gscompleter.reconstructors.plane_sweep.measuring import Measured, inverse_at, measured
from gscompleter.reconstructors.plane_sweep.rig import Rig, rig_of
from gscompleter.reconstructors.plane_sweep.surfaces import fit_surfaces
from gscompleter.render import Renderer, load_renderer
from gscompleter.types import DepthMap, Gaussians, Reconstruction, View, merge

HALVED_FROM = 192
"""Pixels of the shortest side from which images are matched at half their size, but for two
photographs."""
MIN_ALPHA = 0.7
"""Alpha below which a surface that no view was to show is shown by the view that meets the gap."""


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
        that sees it best, and nothing where another view sees through it; and unless they are
        small they are matched at half their size: surfaces and the joint fit find what that leaves
        out, in an eighth of the time. Where their exposures differ clearly, they are evened out:
        the Gaussians have the mean one.

        Raises:
            InputError: fewer than two views, no baseline between them, an empty depth range.
        """
        views = ranged(views)
        rig = rig_of(views)
        layers = self.layers(rig, views)
        depths = depth_maps(layers, rig.unit, views)
        gains = gains_among(layers, rig.transforms)
        device = views[0].image.device
        even = map(View.evened, views, gains.to(device))
        parts = [self.splat(view, depth) for view, depth in zip(even, depths, strict=True)]
        every, on_cpu = merge(parts).to("cpu"), [view.to("cpu") for view in views]
        chosen = self.chosen(every, on_cpu, layers, rig.transforms)
        fitted = self.fitted(every[chosen], on_cpu, gains)
        rows = [torch.arange(len(part)) for part in parts]
        numbers = [torch.full((len(part),), i) for i, part in enumerate(parts)]
        return Reconstruction(
            fitted.to(device),
            tuple(depths),
            torch.cat(numbers)[chosen].to(device),
            torch.cat(rows)[chosen].to(device),
            None if (gains == 1).all() else gains.to(device),
        )

    def lift(self, views: Sequence[View], wanted: Bool[Tensor, "h w"]) -> Reconstruction:
        """The Gaussians of the pixels `wanted` of the first view, a synthesized image.

        What fills a hole is seen by no photograph, so that its opacities are left alone; and its
        depth is that of the surfaces around it, which half the size tells. Its colours are fitted
        to the synthesized image itself, for drawing takes the half of its sharpness. Other views'
        depths are those that were measured.

        Raises:
            InputError: as a call.
        """
        views = ranged(views)
        rig = rig_of(views)
        first, *others = matched(rig, views, halves=True)
        layers = surfaces_of(rig.images[0], first), *map(as_measured, rig.images[1:], others)
        depths = depth_maps(layers, rig.unit, views)
        rows = torch.nonzero(wanted.reshape(-1))[:, 0]
        blurred = self.splat(views[0], depths[0])[rows]
        gaussians = fit_colours(blurred.to("cpu"), [views[0].to("cpu")], self.renderer)
        return Reconstruction(
            gaussians.to(rows.device), tuple(depths), torch.zeros_like(rows), rows
        )

    def depths(self, views: Sequence[View]) -> list[DepthMap]:
        """z-depth of all pixels of `views`, valid where it was measured, and how sure of it."""
        views = ranged(views)
        rig = rig_of(views)
        return depth_maps(self.layers(rig, views), rig.unit, views)

    def layers(self, rig: Rig, views: Sequence[View]) -> list[Layer]:
        """What stereo says of each view."""
        found = matched(rig, views, halves=len(views) > 2)
        return side_by_side(surfaces_of, rig.images, found)

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

    def fitted(
        self, gaussians: Gaussians, views: Sequence[View], gains: Float[Tensor, "views 3"]
    ) -> Gaussians:
        """`gaussians` fitted to `views`, which are brighter by `gains` than they are."""
        if len(views) == 2:
            return fit_appearance(gaussians, views, self.renderer)
        return fit_jointly(gaussians, views, gains, self.renderer)

    def splat(self, view: View, depth: DepthMap) -> Gaussians:
        """A disc for every pixel of `view`."""
        return discs(view, depth.depth, normals_of(depth.depth, view), self.disc_sigma)


def ranged(views: Sequence[View]) -> list[View]:
    """`views` with one depth range.

    Raises:
        InputError: where it is empty, or photographs that were given none do not tell it.
    """
    near, far = depth_range_of(views)
    return [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]


def matched(rig: Rig, views: Sequence[View], halves: bool) -> list[Measured]:
    """What stereo measures in each of `views`. Large ones are matched at half their size first, and
    with `halves` no further."""
    near, far = depth_range_of(views)
    if min(min(image.size) for image in rig.images) < HALVED_FROM:
        return measured(rig, near, far)
    return measured(rig.halved(), near, far) if halves else measured(rig, near, far, True)


def surfaces_of(image: StereoImage, found: Measured) -> Layer:
    """The surfaces of a view through what was measured there."""
    full = found.at_size(image.size)
    heights = fit_surfaces(full.index, full.weight, image.image)
    return Layer(image, inverse_at(full.planes, heights), full.confidence)


def as_measured(image: StereoImage, found: Measured) -> Layer:
    """What was measured in a view, without surfaces."""
    full = found.at_size(image.size)
    return Layer(image, inverse_at(full.planes, full.index), full.confidence)


def depth_maps(layers: Sequence[Layer], unit: float, views: Sequence[View]) -> list[DepthMap]:
    """z-depths in scene units, on the device of the views."""
    depths = []
    for layer, view in zip(layers, views, strict=True):
        depth = torch.from_numpy(np.float32(unit) / layer.inverse)
        confidence = torch.from_numpy(layer.confidence).to(view.image.device)
        depths.append(DepthMap(depth.to(confidence.device), confidence > 0, confidence))
    return depths


def gains_among(layers: Sequence[Layer], transforms: Transforms) -> Float[Tensor, "views 3"]:
    """By how much each photograph is brighter than the mean of all; two keep their exposures."""
    gains = gains_of(layers, transforms) if len(layers) > 2 else np.ones((len(layers), 3))
    return torch.from_numpy(gains).float()


def as_rows(masks: Sequence[Mask]) -> Bool[Tensor, "n"]:
    """Masks of the views one after the other, row by row."""
    return torch.cat([torch.from_numpy(mask).reshape(-1) for mask in masks])
