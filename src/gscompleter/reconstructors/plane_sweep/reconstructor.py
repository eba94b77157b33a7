"""From posed photographs to Gaussians, step by step."""

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
"""Pixels of the shortest side from which images are matched at half their size, but for two
photographs."""


@dataclass(frozen=True)
class PlaneSweep(Splatter):
    """Plane-sweep stereo, completed by surfaces, splatted, and fitted to the photographs."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Gaussians of what `views` show, as `scene` tells, and the depths of all of their pixels.

        More views than two, unless they are small, are matched at half their size: surfaces and the
        joint fit find what that leaves out, in an eighth of the time.

        Raises:
            InputError: fewer than two views, no baseline between them, an empty depth range.
        """
        views = ranged(views)
        rig = rig_of(views)
        layers = self.layers(rig, views)
        return self.scene(views, depth_maps(layers, rig.unit, views), layers, rig.transforms)

    def lift(self, views: Sequence[View], wanted: Bool[Tensor, "h w"]) -> Reconstruction:
        """The Gaussians of the pixels `wanted` of the first view, a synthesized image.

        What fills a hole is seen by no photograph, so that its opacities are left alone; and its
        depth is that of the surfaces around it, measured at the full size, so that it agrees with
        the context as well as a reconstruction of the pair would. Its colours are fitted to the
        synthesized image itself, for drawing takes the half of its sharpness. Other views' depths
        are those that were measured. The sky tells no depth here; the scene has it.

        Raises:
            InputError: as a call.
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
        """z-depth of all pixels of `views`, valid where it was measured, and how sure of it."""
        views = ranged(views)
        rig = rig_of(views)
        return depth_maps(self.layers(rig, views), rig.unit, views)

    def layers(self, rig: Rig, views: Sequence[View]) -> list[Layer]:
        """What stereo says of each view."""
        found = matched(rig, views)
        seen = skies(rig, found)
        surfaces = side_by_side(surfaces_of, rig.images, map(without, found, seen))
        return list(map(before_sky, surfaces, found, seen))


def ranged(views: Sequence[View]) -> list[View]:
    """`views` with one depth range.

    Raises:
        InputError: where it is empty, or photographs that were given none do not tell it.
    """
    near, far = depth_range_of(views)
    return [replace(v, camera=replace(v.camera, near=near, far=far)) for v in views]


def matched(rig: Rig, views: Sequence[View]) -> list[Measured]:
    """Measure depth in each of `views` by stereo, outside of what is ignored; more than two large
    views at half their size."""
    is_halved = len(views) > 2 and min(min(image.size) for image in rig.images) >= HALVED_FROM
    found = measured(rig.halved() if is_halved else rig, *depth_range_of(views))
    return [
        one if image.ignored is None else without(one, image.ignored)
        for one, image in zip(found, rig.images, strict=True)
    ]


def surfaces_of(image: StereoImage, found: Measured) -> Layer:
    """The surfaces of a view through what was measured there."""
    full = found.at_size(image.size)
    heights = fit_surfaces(full.index, full.weight, image.image)
    return Layer(image, inverse_at(full.planes, heights), full.confidence)


def as_measured(image: StereoImage, found: Measured) -> Layer:
    """What was measured in a view, without surfaces."""
    full = found.at_size(image.size)
    return Layer(image, inverse_at(full.planes, full.index), full.confidence)


def before_sky(layer: Layer, found: Measured, sky: Mask) -> Layer:
    """`layer` with the sky of its view behind it, which is sure."""
    beyond = np.float32(found.planes[0] / SKY_DEPTH)
    inverse = np.where(sky, beyond, layer.inverse)
    return replace(
        layer, inverse=inverse, confidence=np.where(sky, np.float32(1), layer.confidence)
    )


def depth_maps(layers: Sequence[Layer], unit: float, views: Sequence[View]) -> list[DepthMap]:
    """z-depths in scene units, on the device of the views; those of the sky tell nothing."""
    depths = []
    for layer, view in zip(layers, views, strict=True):
        depth = torch.from_numpy(np.float32(unit) / layer.inverse)
        confidence = torch.from_numpy(layer.confidence).to(view.image.device)
        depth = depth.to(confidence.device)
        valid = (confidence > 0) & ~is_sky(depth, view.camera)
        depths.append(DepthMap(depth, valid, confidence.where(valid, 0.0)))
    return depths
