"""Depth Anything 3 as a reconstructor Ψ for photographs with given cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.models.depth_anything.alignment import fit_center_similarity, fit_robust_similarity
from gscompleter.models.depth_anything.inputs import Batch, ResizeConfig, create_any_view_batch
from gscompleter.models.depth_anything.metric import MetricDepthAnything, set_sky_depth
from gscompleter.models.depth_anything.nested import NestedDepthAnything, NestedPrediction
from gscompleter.models.depth_anything.network import DepthAnything, Prediction
from gscompleter.models.depth_anything.normalisation import compute_scene_units, normalize_poses
from gscompleter.models.depth_anything.placing import move_from_first_camera
from gscompleter.models.depth_anything.poses import Poses
from gscompleter.models.depth_anything.scene_scale import estimate_units_per_metre
from gscompleter.models.feed_forward.gaussian_adapter import PixelGaussians
from gscompleter.models.feed_forward.precision import check_precision, lower_precision
from gscompleter.models.feed_forward.reconstructor import flatten_gaussians
from gscompleter.numerics.geometry import compute_z_depths
from gscompleter.types import DepthMap, Reconstruction, View

UnitFunction = Callable[[Float[Tensor, "b v 3"]], Float[Tensor, "b"]]
"""Function from camera centres to the unit of the poses, in scene units."""


@dataclass(frozen=True)
class Inference:
    """Settings of a network's inference."""

    sizing: ResizeConfig = ResizeConfig()
    compute_units: UnitFunction = compute_scene_units
    """Unit of the poses for the network; `compute_authors_units` is the authors' choice."""
    dtype: torch.dtype = torch.float32
    """Precision of the transformer under autocast; bfloat16 and float16 need a GPU (untested)."""


@dataclass(frozen=True)
class AnyViewDepth:
    """Joint depth of several views, in the unit of their cameras."""

    network: DepthAnything
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(get_device(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """Predict z-depths and confidence, scaled from predicted to given camera distances.

        Raises:
            InputError: Fewer than two views, or all at one position.
        """
        batch = create_any_view_batch(views, self.inference.sizing, min_views=2)
        predicted = run_depth_network(self.network, batch, self.inference)
        assert isinstance(predicted, Prediction)
        # The network predicts cameras too, in the unit of its depths. Their distances, compared
        # with the given ones, scale the depths.
        (given_centers,) = get_camera_centers(batch.poses)
        (predicted_centers,) = get_camera_centers(predicted.poses)
        scale = fit_robust_similarity(given_centers, predicted_centers).scale
        depth = predicted.depth[0] / scale
        return resample_depth_maps(
            depth, normalize_confidence(predicted.confidence[0]), batch, views
        )


@dataclass(frozen=True)
class MetricViewDepth:
    """Metric depth of single views, scaled to the unit of the cameras."""

    network: MetricDepthAnything
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(get_device(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """Predict z-depths, invalid in the sky.

        Raises:
            InputError: Fewer than two views, all at one position, or too few common features.
        """
        batch = create_any_view_batch(views, self.inference.sizing, min_views=2)
        device = get_device(self.network)
        with torch.no_grad(), lower_precision(device, self.inference.dtype):
            predicted = self.network(batch.images.to(device))
        metres = predicted.convert_to_metres(batch.poses.K.to(device))
        depth = set_sky_depth(metres, predicted.solid_mask)[0]
        maps = resample_depth_maps(depth, predicted.solid_mask[0].float(), batch, views)
        # Given cameras have a unit of their own: triangulated features tell it in metres.
        factor = estimate_units_per_metre(views, maps)
        return [replace(depth_map, depth=factor * depth_map.depth) for depth_map in maps]


@dataclass(frozen=True)
class AnyViewGaussians:
    """Gaussians of several views from the Gaussian head."""

    network: DepthAnything | NestedDepthAnything
    inference: Inference = Inference()

    def __post_init__(self) -> None:
        check_precision(get_device(self.network), self.inference.dtype)

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct a Gaussian per pixel of the resized photographs, and their z-depths.

        Predicted cameras are aligned to the given ones by the first camera and the scale.

        Raises:
            InputError: Fewer than two views, or all at one position.
        """
        batch = create_any_view_batch(views, self.inference.sizing, min_views=2)
        predicted = run_depth_network(self.network, batch, self.inference)
        if isinstance(predicted, NestedPrediction):
            any_view = predicted.any_view
            solid = predicted.metric.solid_mask
        else:
            any_view = predicted
            solid = torch.ones_like(predicted.depth, dtype=torch.bool)
        sure = normalize_confidence(any_view.confidence) * solid
        return create_any_view_reconstruction(
            move_to_given_frame(any_view, batch.poses), sure[0], batch, views
        )


def get_device(network: torch.nn.Module) -> torch.device:
    """Return the device of a network."""
    return next(network.parameters()).device


def run_depth_network(
    network: DepthAnything | NestedDepthAnything, batch: Batch, inference: Inference
) -> Prediction | NestedPrediction:
    """Run a network on a batch, with poses in normalised units."""
    device = get_device(network)
    poses = normalize_poses(batch.poses, inference.compute_units(batch.poses.centers))
    # Not torch.inference_mode: later stages optimise these tensors.
    with torch.no_grad(), lower_precision(device, inference.dtype):
        return network(batch.images.to(device), Poses(poses.c2w.to(device), poses.K.to(device)))


def get_camera_centers(poses: Poses) -> Float[np.ndarray, "b v 3"]:
    """Return the camera centres of each scene."""
    # In this order: the GPU of a Mac has no float64.
    return poses.centers.cpu().double().numpy()


def normalize_confidence(confidence: Float[Tensor, "*n h w"]) -> Float[Tensor, "*n h w"]:
    """Map confidence from [1, ∞) to [0, 1)."""
    return 1 - 1 / confidence


def resample_depth_maps(
    depth: Float[Tensor, "v h w"],
    confidence: Float[Tensor, "v h w"],
    batch: Batch,
    views: Sequence[View],
) -> list[DepthMap]:
    """Resample depth maps from the windows to the photographs, on their device."""
    device = views[0].image.device
    maps = zip(batch.windows, depth.to(device), confidence.to(device), views, strict=True)
    return [window.resample_depth_map(z, sure, view.camera) for window, z, sure, view in maps]


def move_to_given_frame(predicted: Prediction, given: Poses) -> PixelGaussians:
    """Transform the Gaussians to the frame and unit of the given cameras."""
    pairs = zip(get_camera_centers(predicted.poses), get_camera_centers(given), strict=True)
    factors = [fit_center_similarity(*pair).scale for pair in pairs]
    # The predicted frame is that of the first camera.
    first = given.c2w[:, 0].to(predicted.depth)
    return move_from_first_camera(predicted.create_gaussians(first.new_tensor(factors)), first)


def create_any_view_reconstruction(
    gaussians: PixelGaussians,
    confidence: Float[Tensor, "v h w"],
    batch: Batch,
    views: Sequence[View],
) -> Reconstruction:
    """Create the reconstruction of one scene, on the device of its views."""
    device = views[0].image.device
    means = gaussians.means[0].to(device)
    per_view = zip(means.flatten(1, 2), views, strict=True)
    z = torch.stack([compute_z_depths(m, view.camera) for m, view in per_view])
    z = z.view(means.shape[:3])

    # Behind its camera a Gaussian has no depth; a large one keeps the interpolation finite, and is
    # marked as invalid by its confidence.
    ahead = z > 0
    sure = confidence.to(device) * ahead
    depths = resample_depth_maps(z.where(ahead, z.abs().max()), sure, batch, views)

    # The photograph and the pixel that each Gaussian comes from.
    pixels = [
        window.compute_pixel_indices(view.camera)
        for window, view in zip(batch.windows, views, strict=True)
    ]
    numbers = torch.arange(len(views)).repeat_interleave(z[0].numel())
    return Reconstruction(
        flatten_gaussians(gaussians).to(device),
        tuple(depths),
        numbers.to(device),
        torch.cat(pixels).to(device),
    )
