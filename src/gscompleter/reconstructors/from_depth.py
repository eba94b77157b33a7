"""Ψ from any depth model: its depths become Gaussians, which are fitted to the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.value_checks import check_depths, check_given_views
from gscompleter.reconstructors.features.depth_range import get_depth_range, set_depth_range
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
    make_stereo_images,
)
from gscompleter.reconstructors.plane_sweep.fusion import DepthLayer
from gscompleter.reconstructors.plane_sweep.gaussians import Splatter
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import DepthMap, Reconstruction, View


@runtime_checkable
class DepthModel(Protocol):
    """Interface of a model that predicts the depth of posed photographs."""

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """Predict the z-depth of each view, in scene units."""
        ...


@dataclass(frozen=True, kw_only=True)
class FromDepth(Splatter):
    """Reconstructor on top of a depth model."""

    model: DepthModel

    @run_in_plain_torch
    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Predict depths and build the scene; errors as in `PlaneSweep.__call__`."""
        check_given_views(views)
        views = set_depth_range(views, *get_depth_range(views))
        images, unit = make_stereo_images(views)
        depths = self.predict(views)
        layers = [
            make_given_layer(image, depth, unit)
            for image, depth in zip(images, depths, strict=True)
        ]
        transforms = {
            (i, j): compute_source_from_reference(images[i], images[j])
            for i, j in permutations(range(len(images)), 2)
        }
        return self.build_scene(views, depths, layers, transforms)

    def lift(self, views: Sequence[View], pixel_mask: Bool[Tensor, "h w"]) -> Reconstruction:
        """Lift the pixels of `pixel_mask` in the first view; errors as in `__call__`."""
        views = set_depth_range(views, *get_depth_range(views))
        return self.lift_pixels(views, self.predict(views), pixel_mask)

    def predict(self, views: Sequence[View]) -> list[DepthMap]:
        """Predict depths; raise InputError if the model returns none that fit the views."""
        depths = self.model(views)
        check_depths(depths, views)
        return list(depths)


def make_given_layer(image: StereoImage, depth: DepthMap, unit: float) -> DepthLayer:
    """Convert a predicted depth map to inverse depth per widest baseline (`unit`)."""
    inverse = (unit / depth.depth.detach().cpu().double()).float().numpy()
    sure = depth.valid.float() if depth.confidence is None else depth.confidence
    return DepthLayer(image, inverse, np.ascontiguousarray(sure.detach().cpu().float().numpy()))
