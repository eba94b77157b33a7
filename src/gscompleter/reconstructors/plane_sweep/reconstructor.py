"""The plane-sweep reconstructor, from posed photographs to Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.kernels.sharing import side_by_side
from gscompleter.matching.depth_range import depth_range_of
from gscompleter.matching.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.confidence import Mask
from gscompleter.reconstructors.plane_sweep.fusion import Layer
from gscompleter.reconstructors.plane_sweep.measuring import Measured, inverse_at, measured
from gscompleter.reconstructors.plane_sweep.open_sky import skies, sky_above, sky_shown, without
from gscompleter.reconstructors.plane_sweep.rig import Rig, rig_of
from gscompleter.reconstructors.plane_sweep.splatter import Splatter
from gscompleter.reconstructors.plane_sweep.surfaces import fit_surfaces
from gscompleter.sky import SKY_DEPTH, is_sky
from gscompleter.types import DepthMap, Reconstruction, View

HALVED_FROM = 192
"""Shortest side, in pixels, from which three or more images are matched at half size."""


@dataclass(frozen=True)
class PlaneSweep(Splatter):
    """Reconstructor by plane-sweep stereo, surface completion and splatting."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct the scene and the depth of every pixel.

        More than two large views are matched at half size, which takes an eighth of the time.

        Raises:
            InputError: There are fewer than two views, no baseline, or the depth range is empty.
        """
        views = ranged(views)
        rig = rig_of(views)
        layers = self.layers(rig, views)
        return self.scene(views, depth_maps(layers, rig.unit, views), layers, rig.transforms)

    def lift(self, views: Sequence[View], wanted: Bool[Tensor, "h w"]) -> Reconstruction:
        """Lift the pixels of `pixel_mask` in the first view, a synthesized image.

        No photograph observes a hole, so its opacities are not fitted; its depth continues the
        surfaces around it, at full size. Colours are fitted to the image itself. The sky gets no
        depth.
        """
        views = ranged(views)
        rig = rig_of(views)
        first, second = matched(rig, views)
        open_there = sky_above(rig.images[1], second)
        layers = [
            surfaces_of(rig.images[0], without(first, sky_shown(rig, open_there))),
            as_measured(rig.images[1], without(second, open_there)),
        ]
        return self.wanted_of(views, depth_maps(layers, rig.unit, views), wanted)

    def depths(self, views: Sequence[View]) -> list[DepthMap]:
        """Estimate z-depth and confidence of every pixel, in scene units."""
        views = ranged(views)
        rig = rig_of(views)
        return depth_maps(self.layers(rig, views), rig.unit, views)

    def layers(self, rig: Rig, views: Sequence[View]) -> list[Layer]:
        """Compute the completed inverse depth of each view."""
        found = matched(rig, views)
        seen = skies(rig, found)
        surfaces = side_by_side(surfaces_of, rig.images, map(without, found, seen))
        return list(map(before_sky, surfaces, found, seen))


def ranged(views: Sequence[View]) -> list[View]:
    """Give all views the same depth range, estimated if unknown."""
    near, far = depth_range_of(views)
    return [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]


def matched(rig: Rig, views: Sequence[View]) -> list[Measured]:
    """Measure depth outside the ignored pixels, at half size for three or more large views."""
    is_halved = len(views) > 2 and min(min(image.size) for image in rig.images) >= HALVED_FROM
    found = measured(rig.halved() if is_halved else rig, *depth_range_of(views))
    return [
        one if image.ignored is None else without(one, image.ignored)
        for one, image in zip(found, rig.images, strict=True)
    ]


def surfaces_of(image: StereoImage, found: Measured) -> Layer:
    """Fit surfaces to the measured depths of a view."""
    full = found.at_size(image.size)
    heights = fit_surfaces(full.index, full.weight, image.image)
    return Layer(image, inverse_at(full.planes, heights), full.confidence)


def as_measured(image: StereoImage, found: Measured) -> Layer:
    """Convert the measured depths of a view without surface completion."""
    full = found.at_size(image.size)
    return Layer(image, inverse_at(full.planes, full.index), full.confidence)


def before_sky(layer: Layer, found: Measured, sky: Mask) -> Layer:
    """Set the sky of a layer to the sky depth, with full confidence."""
    beyond = np.float32(found.planes[0] / SKY_DEPTH)
    inverse = np.where(sky, beyond, layer.inverse)
    return replace(
        layer, inverse=inverse, confidence=np.where(sky, np.float32(1), layer.confidence)
    )


def depth_maps(layers: Sequence[Layer], unit: float, views: Sequence[View]) -> list[DepthMap]:
    """Convert layers to z-depths in scene units; the sky is not valid."""
    depths = []
    for layer, view in zip(layers, views, strict=True):
        depth = torch.from_numpy(np.float32(unit) / layer.inverse)
        confidence = torch.from_numpy(layer.confidence).to(view.image.device)
        depth = depth.to(confidence.device)
        valid = (confidence > 0) & ~is_sky(depth, view.camera)
        depths.append(DepthMap(depth, valid, confidence.where(valid, 0.0)))
    return depths
