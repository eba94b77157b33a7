"""The plane-sweep reconstructor, from posed photographs to Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.geometry import compute_sparse_depth, measure_baseline, unproject
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.numerics.sky import SKY_DEPTH, is_sky
from gscompleter.reconstructors.depth_predictors import (
    DepthPredictor,
    predict_depth,
    predict_nothing,
)
from gscompleter.reconstructors.features.depth_range import get_depth_range, set_depth_range
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.fusion import DepthLayer
from gscompleter.reconstructors.plane_sweep.gaussians import Splatter
from gscompleter.reconstructors.plane_sweep.given_depth import add_given, measure_nothing
from gscompleter.reconstructors.plane_sweep.near_plane import find_near_plane
from gscompleter.reconstructors.plane_sweep.predicted_depth import add_prediction
from gscompleter.reconstructors.plane_sweep.rig import Rig, build_rig
from gscompleter.reconstructors.plane_sweep.sky_mask import find_skies, find_sky, transfer_sky
from gscompleter.reconstructors.plane_sweep.surfaces import ITERATIONS, fit_surfaces
from gscompleter.reconstructors.plane_sweep.sweep import (
    Mask,
    Measurement,
    compute_inverse_depth,
    measure_depths,
)
from gscompleter.types import DepthMap, Reconstruction, View

LIFT_ITERATIONS = ITERATIONS // 2
"""Iterations of the surfaces of a synthesized image, which registration corrects."""
MIN_HALVED_LIFT = 320.0
"""Shortest side, in pixels, from which a synthesized image and its anchor are matched at half size,
which takes an eighth of the time. Photographs never are: of five it would cost 0.4 dB."""


@dataclass(frozen=True)
class PlaneSweep(Splatter):
    """Reconstructor by plane-sweep stereo, surface completion and splatting."""

    name: ClassVar[str] = "plane-sweep"

    predict_depth: DepthPredictor = predict_nothing
    """Monocular depth, used where stereo measures nothing."""

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct the scene and the depth of every pixel."""
        views = set_depth_range(views, *get_depth_range(views))
        rig = build_rig(views)
        layers = self.compute_layers(rig, views)
        depths = make_depth_maps(layers, rig.unit, views)
        return self.build_scene(views, depths, layers, rig.transforms)

    def find_near_plane(self, views: Sequence[View], near: float, far: float) -> float:
        """Find a near plane that no surface of the photographs stands before; at most `near`."""
        return near if len(views) == 1 else find_near_plane(views, near, far)

    def lift(self, views: Sequence[View], pixel_mask: Bool[Tensor, "h w"]) -> Reconstruction:
        """Lift the pixels of `pixel_mask` in the first view, a synthesized image.

        No photograph observes a hole, so its opacities are not fitted; its depth continues the
        surfaces around it. Colours are fitted to the image itself. The sky gets no
        depth. At the place of an anchor with given depth there is no parallax, and the given
        surfaces are continued.
        """
        views = set_depth_range(views, *get_depth_range(views))
        if len(views[1].known_depths) and measure_baseline(*(v.camera for v in views)) == 0:
            return self.lift_in_place(views[0], views[1], pixel_mask)
        rig = build_rig(views)
        first, second = match_views(rig, views, MIN_HALVED_LIFT)
        first = add_given(first, rig.images[0])
        first = add_prediction(first, predict_depth(self.predict_depth, views[0]))

        # The sky is found in the photograph and carried over by direction; the synthesized image
        # only has to be even there.
        sky_of_second = find_sky(rig.images[1], second)
        sky_of_first = transfer_sky(rig, sky_of_second)
        layers = [
            make_layer(rig.images[0], first.exclude(sky_of_first), LIFT_ITERATIONS),
            make_layer(rig.images[1], second.exclude(sky_of_second), 0),
        ]
        return self.lift_pixels(views, make_depth_maps(layers, rig.unit, views), pixel_mask)

    def lift_in_place(
        self, image: View, anchor: View, pixel_mask: Bool[Tensor, "h w"]
    ) -> Reconstruction:
        """Lift an image by the given depth of a photograph from the same place."""
        assert anchor.given_depth is not None
        # Both cameras have one centre and may differ in rotation, so that the given depths are
        # carried over as points.
        known = anchor.given_depth > 0
        points = unproject(anchor.given_depth, anchor.camera)[known]
        turned = replace(image, given_depth=compute_sparse_depth(points, image.camera))
        (depth,) = self.estimate_depths([turned])
        return self.lift_pixels([image], [depth, DepthMap(anchor.given_depth, known)], pixel_mask)

    def estimate_depths(self, views: Sequence[View]) -> list[DepthMap]:
        """Estimate z-depth and confidence of every pixel, in scene units."""
        views = set_depth_range(views, *get_depth_range(views))
        rig = build_rig(views)
        return make_depth_maps(self.compute_layers(rig, views), rig.unit, views)

    def compute_layers(self, rig: Rig, views: Sequence[View]) -> list[DepthLayer]:
        """Compute the completed inverse depth of each view."""
        measured = [
            add_given(measurement, image)
            for measurement, image in zip(match_views(rig, views), rig.images, strict=True)
        ]
        # The sky is judged by measurements alone, before predictions fill its pixels. Surfaces are
        # fitted without it, as its matches are arbitrary, and it gets its depth afterwards.
        skies = find_skies(rig, measured)
        observed = [
            add_prediction(measurement, predict_depth(self.predict_depth, view)).exclude(sky)
            for measurement, view, sky in zip(measured, views, skies, strict=True)
        ]
        surfaces = map_in_parallel(make_layer, rig.images, observed)
        return [
            add_sky(surface, measurement, sky)
            for surface, measurement, sky in zip(surfaces, measured, skies, strict=True)
        ]


def match_views(
    rig: Rig, views: Sequence[View], min_halved_side: float = math.inf
) -> list[Measurement]:
    """Measure depth outside the ignored pixels, at half size if all images are large enough.

    A single photograph has no stereo, and nothing is measured.
    """
    near, far = get_depth_range(views)
    if len(views) == 1:
        return [measure_nothing(rig.images[0], near / rig.unit, far / rig.unit)]
    is_halved = min(min(image.size) for image in rig.images) >= min_halved_side
    measurements = measure_depths(rig.halve() if is_halved else rig, near, far)
    return [
        measurement if image.ignore_mask is None else measurement.exclude(image.ignore_mask)
        for measurement, image in zip(measurements, rig.images, strict=True)
    ]


def make_layer(
    image: StereoImage, measured: Measurement, iterations: int = ITERATIONS
) -> DepthLayer:
    """Convert the measured depths of a view to a layer, by surfaces after so many iterations."""
    full = measured.resize_to(image.size)
    index = fit_surfaces(full.index, full.weight, image.image, iterations)
    return DepthLayer(image, compute_inverse_depth(full.planes, index), full.confidence)


def add_sky(layer: DepthLayer, measured: Measurement, sky: Mask) -> DepthLayer:
    """Set the sky of a layer to the sky depth, with full confidence."""
    # The first plane is the far plane, in inverse depth.
    inverse_sky_depth = np.float32(measured.planes[0] / SKY_DEPTH)
    return DepthLayer(
        layer.image,
        inverse=np.where(sky, inverse_sky_depth, layer.inverse),
        confidence=np.where(sky, np.float32(1), layer.confidence),
    )


def make_depth_maps(
    layers: Sequence[DepthLayer], unit: float, views: Sequence[View]
) -> list[DepthMap]:
    """Convert layers to z-depths in scene units; the sky is not valid."""
    depths = []
    for layer, view in zip(layers, views, strict=True):
        depth = torch.from_numpy(np.float32(unit) / layer.inverse)
        confidence = torch.from_numpy(layer.confidence).to(view.image.device)
        depth = depth.to(confidence.device)
        valid = (confidence > 0) & ~is_sky(depth, view.camera)
        depths.append(DepthMap(depth, valid, confidence.where(valid, 0.0)))
    return depths
