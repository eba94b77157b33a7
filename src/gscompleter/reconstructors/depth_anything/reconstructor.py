"""Ψ: what the networks of Depth Anything 3 make of photographs with given cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import z_depths
from gscompleter.reconstructors.depth_anything.alignment import (
    similarity_between,
    similarity_of_most,
)
from gscompleter.reconstructors.depth_anything.inputs import Batch, Sizing, batch_of
from gscompleter.reconstructors.depth_anything.metric import MetricDepthAnything, with_far_sky
from gscompleter.reconstructors.depth_anything.nested import NestedDepthAnything, NestedPrediction
from gscompleter.reconstructors.depth_anything.network import DepthAnything, Prediction
from gscompleter.reconstructors.depth_anything.normalisation import scene_units, seen_from_first
from gscompleter.reconstructors.depth_anything.placing import placed
from gscompleter.reconstructors.depth_anything.poses import Poses
from gscompleter.reconstructors.depth_anything.scene_scale import units_per_metre
from gscompleter.reconstructors.feed_forward.gaussian_adapter import PixelGaussians
from gscompleter.reconstructors.feed_forward.precision import check_precision, lower_precision
from gscompleter.reconstructors.feed_forward.reconstructor import gaussians_of
from gscompleter.types import DepthMap, Reconstruction, View

UnitOf = Callable[[Float[Tensor, "b v 3"]], Float[Tensor, "b"]]
"""From camera centres to the unit, in scene units, in which a network is told of them."""


@dataclass(frozen=True)
class Inference:
    """How a network is run."""

    sizing: Sizing = Sizing()
    """How photographs are resized for it."""
    unit_of: UnitOf = scene_units
    """The unit in which the network is told of the cameras; `authors_units` is the authors'."""
    dtype: torch.dtype = torch.float32
    """bfloat16 or float16 let a GPU run the transformer in lower precision (autocast); heads and
    geometry stay in float32. A CPU takes float32 only. No test covers it on a GPU."""


@dataclass(frozen=True)
class AnyViewDepth:
    """Depth of several views at once, in the unit of their cameras."""

    network: DepthAnything
    """With its weights, on the device where it is to run."""
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(device_of(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """z-depths, and how sure the network is of them.

        The network predicts the cameras again. By how much these stand wider apart than the given
        ones, its depths are too large.

        Raises:
            InputError: fewer than two views, or all of them in one place.
        """
        batch = batch_of(views, self.inference.sizing, fewest=2)
        predicted = predict(self.network, batch, self.inference)
        assert isinstance(predicted, Prediction)
        (given,), (found,) = centers_of(batch.poses), centers_of(predicted.poses)
        depth = predicted.depth[0] / similarity_of_most(given, found).scale
        return depth_maps(depth, certainty(predicted.confidence[0]), batch, views)


@dataclass(frozen=True)
class MetricViewDepth:
    """Depth of each view by itself, brought from metres to the unit of the cameras."""

    network: MetricDepthAnything
    """With its weights, on the device where it is to run."""
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(device_of(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """z-depths; those of the sky are not valid.

        Raises:
            InputError: fewer than two views, all in one place, or with too few features in common
                to tell how long a metre is.
        """
        batch = batch_of(views, self.inference.sizing, fewest=2)
        device = device_of(self.network)
        with torch.no_grad(), lower_precision(device, self.inference.dtype):
            found = self.network(batch.images.to(device))
        metres = found.in_metres(batch.poses.K.to(device))
        depth = with_far_sky(metres, found.solid)[0]
        maps = depth_maps(depth, found.solid[0].float(), batch, views)
        factor = units_per_metre(views, maps)
        return [replace(known, depth=factor * known.depth) for known in maps]


@dataclass(frozen=True)
class AnyViewGaussians:
    """Gaussians of several views at once, from the network's own head."""

    network: DepthAnything | NestedDepthAnything
    """With its weights and a head for Gaussians, on the device where it is to run."""
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(device_of(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """A Gaussian for each pixel of the resized photographs, and the z-depths of their means.

        The network sets them before cameras that it predicts. The first of these is put where the
        first given one stands, and all are as wide apart as the given ones. Of the sky, where the
        network tells it, no depth is valid.

        Raises:
            InputError: fewer than two views, or all of them in one place.
        """
        batch = batch_of(views, self.inference.sizing, fewest=2)
        predicted = predict(self.network, batch, self.inference)
        if isinstance(predicted, NestedPrediction):
            any_view, solid = predicted.any_view, predicted.metric.solid
        else:
            any_view, solid = predicted, torch.ones_like(predicted.depth, dtype=torch.bool)
        sure = certainty(any_view.confidence) * solid
        return reconstruction_of(in_world(any_view, batch.poses), sure[0], batch, views)


def device_of(network: torch.nn.Module) -> torch.device:
    """Where a network lies."""
    return next(network.parameters()).device


def predict(
    network: DepthAnything | NestedDepthAnything, batch: Batch, inference: Inference
) -> Prediction | NestedPrediction:
    """What a network makes of photographs and their cameras, as it is told of these."""
    device = device_of(network)
    told = seen_from_first(batch.poses, inference.unit_of(batch.poses.centers))
    # Not torch.inference_mode: the stages that follow optimise what comes from here.
    with torch.no_grad(), lower_precision(device, inference.dtype):
        return network(batch.images.to(device), Poses(told.c2w.to(device), told.K.to(device)))


def centers_of(poses: Poses) -> Float[np.ndarray, "b v 3"]:
    """Camera centres of each scene."""
    return poses.centers.double().cpu().numpy()


def certainty(confidence: Float[Tensor, "*n h w"]) -> Float[Tensor, "*n h w"]:
    """What networks tell from 1 upwards, between 0 and 1."""
    return 1 - 1 / confidence


def depth_maps(
    depth: Float[Tensor, "v h w"],
    confidence: Float[Tensor, "v h w"],
    batch: Batch,
    views: Sequence[View],
) -> list[DepthMap]:
    """Maps of the windows as those of the photographs, on their device."""
    device = views[0].image.device
    maps = zip(batch.windows, depth.to(device), confidence.to(device), views, strict=True)
    return [window.depth_map(z, sure, view.camera) for window, z, sure, view in maps]


def in_world(predicted: Prediction, given: Poses) -> PixelGaussians:
    """The Gaussians in the frame and unit of the given cameras."""
    pairs = zip(centers_of(predicted.poses), centers_of(given), strict=True)
    factors = [similarity_between(*pair).scale for pair in pairs]
    first = given.c2w[:, 0].to(predicted.depth)
    return placed(predicted.gaussians(first.new_tensor(factors)), first)


def reconstruction_of(
    gaussians: PixelGaussians,
    confidence: Float[Tensor, "v h w"],
    batch: Batch,
    views: Sequence[View],
) -> Reconstruction:
    """The only scene of a batch, on the device of its views."""
    device = views[0].image.device
    means = gaussians.means[0].to(device)
    per_view = zip(means.flatten(1, 2), views, strict=True)
    z = torch.stack([z_depths(m, view.camera) for m, view in per_view]).view(means.shape[:3])
    ahead = z > 0
    sure = confidence.to(device) * ahead
    depths = depth_maps(z.where(ahead, z.abs().max()), sure, batch, views)
    pixels = [w.pixel_index(v.camera) for w, v in zip(batch.windows, views, strict=True)]
    numbers = torch.arange(len(views)).repeat_interleave(z[0].numel())
    return Reconstruction(
        gaussians_of(gaussians).to(device),
        tuple(depths),
        numbers.to(device),
        torch.cat(pixels).to(device),
    )
