"""The Gaussian head, and conversion of its output to Gaussians in the frame of its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.depth_anything.dpt import Dpt, ImageScratch, add_position_encoding
from gscompleter.models.depth_anything.harmonics import rotate_3dgs_sh
from gscompleter.models.depth_anything.poses import Poses
from gscompleter.models.depth_anything.vit import Tokens
from gscompleter.models.feed_forward.dino import PATCH
from gscompleter.models.feed_forward.gaussian_adapter import PixelGaussians, damp_sh
from gscompleter.models.feed_forward.resampling import resize_bilinear
from gscompleter.numerics.geometry import multiply_quats, rotations_to_quats

SH = 9
"""SH coefficients per colour (degree 2)."""
CHANNELS = (2, 3, 4, 3 * SH, 1, 1)
"""Channels of offset, scale, rotation, SH, depth offset, opacity."""
SCALES = (1e-5, 30.0)
"""Smallest and largest standard deviation, in multiples of the size that `compute_pixel_scales`
calls that of a pixel, as in training."""


class GaussianDpt(Dpt):
    """Predict the raw Gaussian channels of each pixel (`CHANNELS`)."""

    scratch: ImageScratch

    def __init__(self, channels: int, widths: Sequence[int], features: int) -> None:
        super().__init__(channels, widths, has_positions=True)
        self.scratch = ImageScratch(widths, features, sum(CHANNELS))
        # Layers that add features of the image itself to the fused map.
        layers: list[nn.Module] = []
        for width_in, width_out in pairwise([3, features // 8, features // 4, features // 2]):
            layers += [nn.Conv2d(width_in, width_out, 3, 1, 1), nn.GELU()]
        self.images_merger = nn.Sequential(*layers)

    def forward(
        self, tokens: Sequence[Tokens], images: Float[Tensor, "b v 3 h w"]
    ) -> Float[Tensor, "b v h w c"]:
        """Predict raw channels from the tokens of the output blocks and normalised images."""
        size = (images.shape[3], images.shape[4])
        pyramid = self.compute_pyramid(tokens, size[0] // PATCH, size[1] // PATCH)
        x = resize_bilinear(self.scratch.output_conv1(self.scratch(pyramid)), size)
        x = x + self.images_merger(images.flatten(0, 1))
        raw = self.scratch.output_conv2(add_position_encoding(x, size[1] / size[0]))
        return raw.movedim(1, -1).unflatten(0, images.shape[:2])


def create_camera_gaussians(
    raw: Float[Tensor, "b v h w c"],
    depth: Float[Tensor, "b v h w"],
    poses: Poses,
    factors: Float[Tensor, "b"],
) -> PixelGaussians:
    """Create Gaussians in the frame of `poses`, with centres and depths multiplied by `factors`.

    `depth` is z-depth in the unit of `poses`, both as predicted. As in training it is used as
    distance along the ray, and so it is returned.
    """
    offset, scale, rotation, sh, depth_offset, opacity = raw.split(CHANNELS, dim=-1)
    factor = factors[:, None, None, None]
    distance = (depth + depth_offset[..., 0]) * factor

    # Unit rays in the frame of `poses`, through a point beside the pixel centre.
    turns = poses.c2w[..., :3, :3]
    local_rays = compute_offset_rays(offset, poses.K)
    rays = F.normalize(torch.einsum("bvij,bvhwj->bvhwi", turns, local_rays), dim=-1)
    centers = factor[..., None] * poses.centers[:, :, None, None]
    return PixelGaussians(
        depth=distance,
        means=centers + rays * distance[..., None],
        quats=rotate_quats_as_trained(rotation, turns),
        scales=compute_pixel_scales(scale, poses.K) * distance[..., None],
        opacities=opacity[..., 0].sigmoid(),
        sh=rotate_3dgs_sh(damp_sh(sh), turns),
    )


def compute_offset_rays(
    offsets: Float[Tensor, "b v h w 2"], K: Float[Tensor, "b v 3 3"]
) -> Float[Tensor, "b v h w 3"]:
    """Compute directions in camera axes, `offsets` pixels from each pixel centre."""
    h, w = offsets.shape[2:4]
    x = torch.arange(w, device=offsets.device) + 0.5
    y = torch.arange(h, device=offsets.device) + 0.5
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1) + offsets
    points = F.pad(points, (0, 1), value=1.0)
    return torch.einsum("bvij,bvhwj->bvhwi", torch.linalg.inv(K), points)


def compute_pixel_scales(
    scale: Float[Tensor, "b v h w 3"], K: Float[Tensor, "b v 3 3"]
) -> Float[Tensor, "b v h w 3"]:
    """Compute standard deviations at a distance of 1 from raw scales."""
    low, high = SCALES
    # The size of a pixel as the authors have it: a tenth of its width and height at a distance of
    # 1, added up.
    pixel = 0.1 * (1 / K[..., 0, 0] + 1 / K[..., 1, 1])
    return (low + (high - low) * scale.sigmoid()) * pixel[..., None, None, None]


def rotate_quats_as_trained(
    raw: Float[Tensor, "b v h w 4"], turns: Float[Tensor, "b v 3 3"]
) -> Float[Tensor, "b v h w 4"]:
    """Rotate Gaussians with their cameras; returns wxyz quaternions.

    As in training, quaternions are reordered to wxyz but rotated as if they were xyzw.
    """
    x, y, z, w = F.normalize(raw, dim=-1, eps=1e-8).unbind(-1)
    misread = torch.stack([z, w, x, y], dim=-1)  # (w, x, y, z) misread as xyzw, in our order
    rotated = multiply_quats(rotations_to_quats(turns)[:, :, None, None], misread)
    # One of the two quaternions of each rotation, that with positive real part.
    return torch.where(rotated[..., :1] < 0, -rotated, rotated).roll(-1, -1)
