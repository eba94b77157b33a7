"""MVSplat, DepthSplat and VolSplat as reconstructors Ψ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from gscompleter.models.feed_forward.depthsplat import DepthSplat
from gscompleter.models.feed_forward.gaussian_adapter import PixelGaussians
from gscompleter.models.feed_forward.inputs import Crop, create_batch
from gscompleter.models.feed_forward.mvsplat import MVSplat
from gscompleter.models.feed_forward.precision import check_precision, lower_precision
from gscompleter.models.feed_forward.volsplat import VolSplat, VoxelGaussians
from gscompleter.numerics.geometry import compute_z_depths
from gscompleter.types import Gaussians, Reconstruction, View, make_observed

MAX_COEFFICIENTS = 16
"""SH coefficients up to degree 3, the most that renderers of 3DGS use."""


@dataclass(frozen=True)
class FeedForward:
    """Gaussians per pixel, or per voxel, from one pass of a network.

    The networks were trained on scenes in metres or of similar size. The Gaussians of DepthSplat
    and VolSplat have sizes in that unit: scale a scene in millimetres to metres first.
    """

    network: MVSplat | DepthSplat | VolSplat
    dtype: torch.dtype = torch.float32
    """Precision of the network under autocast; bfloat16 and float16 need a GPU (untested)."""
    depth_range: tuple[float, float] | None = None
    """Near and far z-depth for cameras without a range, in scene units: those of the authors'
    evaluation. The networks sweep planes in this range and were trained on no other. If None, the
    range is estimated from matched features."""

    keeps_range: ClassVar[bool] = True
    """A range that is given is not widened to what features show (see `Reconstructor`)."""

    def __post_init__(self) -> None:
        check_precision(self.device, self.dtype)

    @property
    def device(self) -> torch.device:
        """The device of the network."""
        return next(self.network.parameters()).device

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct Gaussians and a z-depth map per view from central crops of equal size.

        Raises:
            InputError: Fewer than two views, images smaller than one patch, an empty depth range,
                or a scene too large for the voxels of VolSplat.
        """
        patch = self.network.config.patch
        images, cameras, crops = create_batch(views, patch, self.depth_range)
        # Not torch.inference_mode: later stages optimise these tensors.
        with torch.no_grad(), lower_precision(self.device, self.dtype):
            predicted = self.network(images.to(self.device), cameras.to(self.device))
        if isinstance(predicted, VoxelGaussians):
            return create_voxel_reconstruction(predicted, views, crops)
        return create_pixel_reconstruction(predicted, views, crops)


def create_pixel_reconstruction(
    predicted: PixelGaussians, views: Sequence[View], crops: Sequence[Crop]
) -> Reconstruction:
    """Create the reconstruction of one scene; z-depths follow from the means."""
    device = views[0].image.device
    gaussians = flatten_gaussians(predicted).to(device)
    per_view = crops[0].height * crops[0].width
    depths = []
    for means, view, crop in zip(gaussians.means.split(per_view), views, crops, strict=True):
        z = compute_z_depths(means, view.camera)
        depths.append(crop.pad_depth(z.view(crop.height, crop.width), view.camera))
    # The photograph and the pixel that each Gaussian comes from.
    pixels = [
        crop.compute_pixel_indices(view.camera.width)
        for view, crop in zip(views, crops, strict=True)
    ]
    numbers = torch.arange(len(views), device=device).repeat_interleave(per_view)
    return Reconstruction(gaussians, tuple(depths), numbers, torch.cat(pixels).to(device))


def create_voxel_reconstruction(
    predicted: VoxelGaussians, views: Sequence[View], crops: Sequence[Crop]
) -> Reconstruction:
    """Create the reconstruction of one scene, without source pixels."""
    device = views[0].image.device
    depths = [
        crop.pad_depth(depth, view.camera)
        for depth, view, crop in zip(predicted.depth.to(device), views, crops, strict=True)
    ]
    return Reconstruction(flatten_gaussians(predicted).to(device), tuple(depths))


def flatten_gaussians(predicted: PixelGaussians | VoxelGaussians) -> Gaussians:
    """Flatten the Gaussians view by view and row by row, with at most `MAX_COEFFICIENTS`."""
    return make_observed(
        predicted.means.flatten(0, -2),
        predicted.quats.flatten(0, -2),
        predicted.scales.flatten(0, -2),
        predicted.opacities.flatten(),
        predicted.sh[..., :MAX_COEFFICIENTS, :].flatten(0, -3),
    )
