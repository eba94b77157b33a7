"""VolSplat (Wang et al., 2025): Gaussians from voxels that average the pixels of all views."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.feed_forward.cameras import Cameras, disable_autocast
from gscompleter.models.feed_forward.depth_predictor import DepthConfig
from gscompleter.models.feed_forward.depthsplat import BASE, DepthSplatConfig
from gscompleter.models.feed_forward.gaussian_adapter import (
    MIN_SCALE,
    compute_z_rays,
    damp_sh,
    move_channels_last,
)
from gscompleter.models.feed_forward.pixel_features import COLOR_CHANNELS, PixelFeatures
from gscompleter.models.feed_forward.sparse import Grid, SparseConv, find_neighbours_within
from gscompleter.models.feed_forward.sparse_unet import SparseUNet
from gscompleter.models.feed_forward.voxels import Voxels, voxelize
from gscompleter.types import sh_from_rgb

NUM_SH = 9
"""SH coefficients (degree 2)."""
CHANNEL_GROUPS = (1, 3, 3, 4, 3 * NUM_SH)
"""Channels of opacity, offset, scale, rotation and SH."""
MAX_VOXEL_OFFSET = 1.5
"""Largest offset of a Gaussian from the mean of its voxel along each axis, in voxels."""


@dataclass(frozen=True)
class VolSplatConfig(DepthSplatConfig):
    """Settings of DepthSplat base, and the voxel size."""

    depth: DepthConfig = BASE
    voxel_resolution: float = 0.001
    """Side length of a voxel, in scene units."""


@dataclass(frozen=True)
class VoxelGaussians:
    """One Gaussian per voxel of `grid`, with the conventions of `Gaussians`."""

    depth: Float[Tensor, "v h w"]
    """z-depth of each view, in scene units."""
    grid: Grid
    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, "n"]
    sh: Float[Tensor, "n 9 3"]


class GaussianHead(nn.Module):
    """Two sparse convolutions from voxel features to raw Gaussian channels."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.conv1 = SparseConv(channels_in, channels_out)
        self.conv2 = SparseConv(channels_out, channels_out)

    def forward(
        self, features: Float[Tensor, "n channels_in"], grid: Grid
    ) -> Float[Tensor, "n channels_out"]:
        """Apply both convolutions."""
        neighbours = find_neighbours_within(grid)
        return self.conv2(F.gelu(self.conv1(features, neighbours)), neighbours)


class VolSplat(PixelFeatures):
    """The VolSplat network: 138 M parameters."""

    def __init__(self, config: VolSplatConfig = VolSplatConfig()) -> None:
        super().__init__(config.depth)
        self.config = config
        # Spelt as in the published weights, whose keys the attributes name.
        self.spare_unet = SparseUNet(self.channels)
        self.gaussian_head = GaussianHead(self.channels, sum(CHANNEL_GROUPS))

    def forward(self, images: Float[Tensor, "b v 3 h w"], cameras: Cameras) -> VoxelGaussians:
        """Predict a Gaussian for each voxel of one scene; see `MultiViewDepth` for the images."""
        if len(images) != 1:
            raise ValueError(f"VolSplat takes one scene at a time, got {len(images)}")
        depth, features = self.compute_pixel_features(images, cameras)
        # Pixels of all views that fall into one voxel are averaged, so that the number of Gaussians
        # follows the scene and not the photographs.
        with disable_autocast(images):
            points = unproject_pixels(depth, cameras)
            rows = move_channels_last(features, cameras).flatten(0, 3)
            voxels = voxelize(points, rows, self.config.voxel_resolution)
            refined = voxels.features + self.spare_unet(voxels.features, voxels.grid)
            raw = self.gaussian_head(refined, voxels.grid)
        return create_voxel_gaussians(raw, voxels, depth[:, 0].float(), self.config)


def unproject_pixels(depth: Float[Tensor, "n 1 h w"], cameras: Cameras) -> Float[Tensor, "p 3"]:
    """Unproject all pixel centres to world space, view by view and row by row."""
    along = move_channels_last(depth, cameras)
    # Offsets of 0: the middle of each pixel (`compute_z_rays` takes them through a sigmoid).
    centered = along.new_zeros((*along.shape[:4], 2))
    in_camera = compute_z_rays(centered, cameras) * along
    rotations = cameras.c2w[..., :3, :3]
    centers = cameras.c2w[:, :, None, None, :3, 3]
    points = centers + torch.einsum("bvij,bvhwj->bvhwi", rotations, in_camera)
    return points.flatten(0, 3)


def create_voxel_gaussians(
    raw: Float[Tensor, "n 38"],
    voxels: Voxels,
    depth: Float[Tensor, "v h w"],
    config: VolSplatConfig,
) -> VoxelGaussians:
    """Create the Gaussians of the voxels; the constant SH is the mean pixel colour."""
    # Activations are those of the authors, whose quaternions are xyzw.
    opacity, offset, scale, rotation, sh = raw.split(CHANNEL_GROUPS, dim=1)
    reach = MAX_VOXEL_OFFSET * config.voxel_resolution
    return VoxelGaussians(
        depth,
        voxels.grid,
        means=voxels.points + (2 * offset.sigmoid() - 1) * reach,
        quats=F.normalize(rotation.roll(1, 1), dim=1),
        scales=F.softplus(scale - 4).clamp(MIN_SCALE, config.gaussian_scale_max),
        opacities=opacity[:, 0].sigmoid(),
        sh=torch.cat([sh_from_rgb(voxels.features[:, COLOR_CHANNELS]), damp_sh(sh)[:, 1:]], dim=1),
    )
