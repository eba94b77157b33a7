"""Ψ of the paper: MVSplat, DepthSplat and VolSplat as reconstructors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import z_depths
from gscompleter.reconstructors.feed_forward.depthsplat import DepthSplat
from gscompleter.reconstructors.feed_forward.gaussian_adapter import PixelGaussians
from gscompleter.reconstructors.feed_forward.inputs import Crop, batch_of
from gscompleter.reconstructors.feed_forward.mvsplat import MVSplat
from gscompleter.reconstructors.feed_forward.precision import check_precision, lower_precision
from gscompleter.reconstructors.feed_forward.volsplat import VolSplat, VoxelGaussians
from gscompleter.types import DepthMap, Gaussians, Reconstruction, View, observed

MAX_COEFFICIENTS = 16
"""Spherical harmonics of degree 3, the highest that rasterisers of 3DGS show.

MVSplat predicts degree 4, too, which its own rasteriser ignores as well.
"""


@dataclass(frozen=True)
class FeedForward:
    """Gaussians of all pixels, or of all voxels, from one pass of a network.

    The networks have learnt the sizes of rooms in metres and of scenes that structure from
    motion brought to a similar size. Depths follow the depth range of the cameras, but the
    Gaussians of DepthSplat, and those and the voxels of VolSplat, have sizes in the unit these
    were trained in: a scene in another unit, say millimetres, must be scaled to metres first.
    """

    network: MVSplat | DepthSplat | VolSplat
    """With its weights, on the device where it is to run."""
    dtype: torch.dtype = torch.float32
    """bfloat16 or float16 let a GPU run the network in lower precision (autocast); geometry
    stays in float32. A CPU takes float32 only. No test covers it on a GPU."""

    def __post_init__(self) -> None:
        check_precision(self.device, self.dtype)

    @property
    def device(self) -> torch.device:
        return next(self.network.parameters()).device

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """A Gaussian for each pixel that the network sees (VolSplat: for each voxel that holds
        such a pixel, without a note of which), and z-depths per view.

        Images are cropped about their centres to one size, in multiples of 16 or 64 pixels;
        outside of the crop depths are not valid.

        Raises:
            InputError: fewer than two views, images smaller than one patch, an empty depth range;
                for VolSplat, poses or depths that spread its voxels too widely to be counted.
        """
        config = self.network.config
        images, cameras, crops = batch_of(views, config.patch, config.near, config.far)
        # Not torch.inference_mode: the stages that follow optimise what comes from here.
        with torch.no_grad(), lower_precision(self.device, self.dtype):
            predicted = self.network(images.to(self.device), cameras.to(self.device))
        if isinstance(predicted, VoxelGaussians):
            return reconstruction_of_voxels(predicted, views, crops)
        return reconstruction_of(predicted, views, crops)


def reconstruction_of(
    predicted: PixelGaussians, views: Sequence[View], crops: Sequence[Crop]
) -> Reconstruction:
    """The only scene of a batch, on the device of its views.

    z-depths follow from the means, which serves networks of z-depth and of distance alike.
    """
    device = views[0].image.device
    gaussians = gaussians_of(predicted).to(device)
    per_view = crops[0].height * crops[0].width
    depths = map(depth_map_of, gaussians.means.split(per_view), views, crops)
    pixels = [crop.pixel_index(v.camera.width) for v, crop in zip(views, crops, strict=True)]
    numbers = torch.arange(len(views), device=device).repeat_interleave(per_view)
    return Reconstruction(gaussians, tuple(depths), numbers, torch.cat(pixels).to(device))


def reconstruction_of_voxels(
    predicted: VoxelGaussians, views: Sequence[View], crops: Sequence[Crop]
) -> Reconstruction:
    """The scene on the device of its views; its Gaussians belong to no particular pixel."""
    device = views[0].image.device
    depths = [
        crop.padded(depth, view.camera)
        for depth, view, crop in zip(predicted.depth.to(device), views, crops, strict=True)
    ]
    return Reconstruction(gaussians_of(predicted).to(device), tuple(depths))


def gaussians_of(predicted: PixelGaussians | VoxelGaussians) -> Gaussians:
    """Those of pixels view by view and row by row; without the harmonics that nothing shows."""
    return observed(
        predicted.means.flatten(0, -2),
        predicted.quats.flatten(0, -2),
        predicted.scales.flatten(0, -2),
        predicted.opacities.flatten(),
        predicted.sh[..., :MAX_COEFFICIENTS, :].flatten(0, -3),
    )


def depth_map_of(means: Float[Tensor, "n 3"], view: View, crop: Crop) -> DepthMap:
    """z-depth of the Gaussians of the crop, in the whole image."""
    z = z_depths(means, view.camera)
    return crop.padded(z.view(crop.height, crop.width), view.camera)
