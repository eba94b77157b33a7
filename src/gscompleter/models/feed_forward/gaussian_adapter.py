"""Conversion of raw channels per pixel to Gaussians in world space."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from gscompleter.models.feed_forward.cameras import Cameras, disable_autocast
from gscompleter.models.feed_forward.spherical_harmonics import rotate_sh
from gscompleter.numerics.geometry import multiply_quats, rotations_to_quats
from gscompleter.types import SH_C0

MVSPLAT_SH = 25
"""SH coefficients of MVSplat (degree 4); renderers of 3DGS use the first 16."""
MVSPLAT_CHANNELS = 2 + 3 + 4 + 3 * MVSPLAT_SH
"""Channels of offset, scale, rotation and SH."""
MVSPLAT_SCALES = (0.5, 15.0)
"""Smallest and largest standard deviation, in fifths of a pixel's width at that distance."""
DEPTHSPLAT_SH = 9
"""SH coefficients of DepthSplat (degree 2)."""
DEPTHSPLAT_CHANNELS = 1 + 2 + 3 + 4 + 3 * DEPTHSPLAT_SH
"""Channels of opacity, offset, scale, rotation and SH."""
MIN_SCALE = 1e-10
"""Smallest standard deviation of DepthSplat, in scene units."""


@dataclass(frozen=True)
class PixelGaussians:
    """One Gaussian per pixel of a batch of views, with the conventions of `Gaussians`."""

    depth: Float[Tensor, "b v h w"]
    """z-depth (DepthSplat) or distance along the ray (MVSplat, Depth Anything), in scene units."""
    means: Float[Tensor, "b v h w 3"]
    quats: Float[Tensor, "b v h w 4"]
    scales: Float[Tensor, "b v h w 3"]
    opacities: Float[Tensor, "b v h w"]
    sh: Float[Tensor, "b v h w k 3"]


def create_mvsplat_gaussians(
    raw: Float[Tensor, "n 84 h w"],
    distance: Float[Tensor, "n 1 h w"],
    opacity: Float[Tensor, "n 1 h w"],
    cameras: Cameras,
) -> PixelGaussians:
    """Create the Gaussians of MVSplat at `distance` along unit rays, in multiples of a pixel."""
    offset, scale, rotation, sh = move_channels_last(raw, cameras).split(
        [2, 3, 4, 3 * MVSPLAT_SH], -1
    )
    depth = move_channels_last(distance, cameras)[..., 0]
    h, w = depth.shape[2:]
    # A fifth of a pixel at a distance of 1: of the mean of its width and its height.
    with disable_autocast(raw):
        focal_inverse = torch.linalg.inv(cameras.K[..., :2, :2])
        pixel = 0.1 * (focal_inverse @ raw.new_tensor([1 / w, 1 / h]).float()).sum(-1)
    low, high = MVSPLAT_SCALES
    footprint = pixel[..., None, None] * depth
    return place_in_world(
        F.normalize(compute_z_rays(offset, cameras), dim=-1),
        depth,
        rotation,
        (low + (high - low) * scale.sigmoid()) * footprint[..., None],
        move_channels_last(opacity, cameras)[..., 0],
        damp_sh(sh),
        cameras,
    )


def create_depthsplat_gaussians(
    raw: Float[Tensor, "n 37 h w"],
    z_depth: Float[Tensor, "n 1 h w"],
    images: Float[Tensor, "n 3 h w"],
    cameras: Cameras,
    max_scale: float,
) -> PixelGaussians:
    """Create the Gaussians of DepthSplat at `z_depth`, with sizes up to `max_scale` scene units."""
    opacity, offset, scale, rotation, sh = move_channels_last(raw, cameras).split(
        [1, 2, 3, 4, 3 * DEPTHSPLAT_SH], -1
    )
    coefficients = damp_sh(sh)
    # The constant coefficient begins at the colour of the pixel, and the network corrects it.
    colour = (move_channels_last(images, cameras) - 0.5) / SH_C0
    constant = coefficients[..., :1, :] + colour[..., None, :]
    return place_in_world(
        compute_z_rays(offset, cameras),
        move_channels_last(z_depth, cameras)[..., 0],
        rotation,
        F.softplus(scale - 4).clamp(MIN_SCALE, max_scale),
        opacity[..., 0].sigmoid(),
        torch.cat([constant, coefficients[..., 1:, :]], dim=-2),
        cameras,
    )


def move_channels_last(
    maps: Float[Tensor, "n c h w"], cameras: Cameras
) -> Float[Tensor, "b v h w c"]:
    """Move channels last and separate the views, in float32."""
    return maps.float().permute(0, 2, 3, 1).unflatten(0, cameras.near.shape)


def compute_z_rays(
    offsets: Float[Tensor, "b v h w 2"], cameras: Cameras
) -> Float[Tensor, "b v h w 3"]:
    """Compute directions of unit z in camera axes, up to half a pixel from each pixel centre."""
    h, w = offsets.shape[2:4]
    x = torch.arange(w, device=offsets.device) + 0.5
    y = torch.arange(h, device=offsets.device) + 0.5
    centers = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    # Within the pixel: the sigmoid lies between 0 and 1.
    points = (centers + offsets.sigmoid() - 0.5) / offsets.new_tensor([w, h])
    with disable_autocast(offsets):
        inverse = torch.linalg.inv(cameras.K)
        return torch.einsum("bvij,bvhwj->bvhwi", inverse, F.pad(points, (0, 1), value=1.0))


def damp_sh(sh: Float[Tensor, "*batch c"]) -> Float[Tensor, "*batch k 3"]:
    """Convert raw channels to SH coefficients, with small factors for higher degrees."""
    coefficients = sh.unflatten(-1, (3, -1)).transpose(-1, -2)
    degrees = range(1, round(coefficients.shape[-2] ** 0.5))
    # Factors of MVSplat and of pixelSplat before it: 0.1 · 4^-degree.
    factors = [1.0] + [0.1 * 0.25**degree for degree in degrees for _ in range(2 * degree + 1)]
    return coefficients * sh.new_tensor(factors)[:, None]


def place_in_world(
    rays: Float[Tensor, "b v h w 3"],
    depth: Float[Tensor, "b v h w"],
    rotations: Float[Tensor, "b v h w 4"],
    scales: Float[Tensor, "b v h w 3"],
    opacities: Float[Tensor, "b v h w"],
    sh: Float[Tensor, "b v h w k 3"],
    cameras: Cameras,
) -> PixelGaussians:
    """Place Gaussians at `depth` along their rays; rotations are xyzw in camera axes."""
    c2w = cameras.c2w[..., :3, :3]
    centers = cameras.c2w[:, :, None, None, :3, 3]
    with disable_autocast(rays):
        means = centers + torch.einsum("bvij,bvhwj->bvhwi", c2w, rays * depth[..., None])
        # xyzw to wxyz.
        own = F.normalize(rotations.roll(1, -1), dim=-1)
        quats = multiply_quats(rotations_to_quats(c2w)[:, :, None, None], own)
    return PixelGaussians(depth, means, quats, scales, opacities, rotate_sh(sh, c2w))
