"""Depth Anything 3 as a reconstructor Ψ for photographs with given cameras."""

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
"""Function from camera centres to the unit of the poses, in scene units."""


@dataclass(frozen=True)
class Inference:
    """Settings of a network's inference."""

    sizing: Sizing = Sizing()
    unit_of: UnitOf = scene_units
    """Unit of the poses for the network; `compute_authors_units` is the authors' choice."""
    dtype: torch.dtype = torch.float32
    """Precision of the transformer under autocast; bfloat16 and float16 need a GPU (untested)."""


@dataclass(frozen=True)
class AnyViewDepth:
    """Joint depth of several views, in the unit of their cameras."""

    network: DepthAnything
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(device_of(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """Predict z-depths and confidence, scaled from predicted to given camera distances.

        Raises:
            InputError: Fewer than two views, or all at one position.
        """
        batch = batch_of(views, self.inference.sizing, fewest=2)
        predicted = predict(self.network, batch, self.inference)
        assert isinstance(predicted, Prediction)
        (given,), (found,) = centers_of(batch.poses), centers_of(predicted.poses)
        depth = predicted.depth[0] / similarity_of_most(given, found).scale
        return depth_maps(depth, certainty(predicted.confidence[0]), batch, views)


@dataclass(frozen=True)
class MetricViewDepth:
    """Metric depth of single views, scaled to the unit of the cameras."""

    network: MetricDepthAnything
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(device_of(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """Predict z-depths, invalid in the sky.

        Raises:
            InputError: Fewer than two views, all at one position, or too few common features.
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
    """Gaussians of several views from the Gaussian head."""

    network: DepthAnything | NestedDepthAnything
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(device_of(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct a Gaussian per pixel of the resized photographs, and their z-depths.

        Predicted cameras are aligned to the given ones by the first camera and the scale.

        Raises:
            InputError: Fewer than two views, or all at one position.
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
    """Return the device of a network."""
    return next(network.parameters()).device


def predict(
    network: DepthAnything | NestedDepthAnything, batch: Batch, inference: Inference
) -> Prediction | NestedPrediction:
    """Run a network on a batch, with poses in normalised units."""
    device = device_of(network)
    poses = seen_from_first(batch.poses, inference.unit_of(batch.poses.centers))
    # Not torch.inference_mode: later stages optimise these tensors.
    with torch.no_grad(), lower_precision(device, inference.dtype):
        return network(batch.images.to(device), Poses(poses.c2w.to(device), poses.K.to(device)))


def centers_of(poses: Poses) -> Float[np.ndarray, "b v 3"]:
    """Return the camera centres of each scene."""
    return poses.centers.double().cpu().numpy()


def certainty(confidence: Float[Tensor, "*n h w"]) -> Float[Tensor, "*n h w"]:
    """Map confidence from [1, ∞) to [0, 1)."""
    return 1 - 1 / confidence


def depth_maps(
    depth: Float[Tensor, "v h w"],
    confidence: Float[Tensor, "v h w"],
    batch: Batch,
    views: Sequence[View],
) -> list[DepthMap]:
    """Resample depth maps from the windows to the photographs, on their device."""
    device = views[0].image.device
    maps = zip(batch.windows, depth.to(device), confidence.to(device), views, strict=True)
    return [window.depth_map(z, sure, view.camera) for window, z, sure, view in maps]


def in_world(predicted: Prediction, given: Poses) -> PixelGaussians:
    """Transform the Gaussians to the frame and unit of the given cameras."""
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
    """Create the reconstruction of one scene, on the device of its views."""
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
