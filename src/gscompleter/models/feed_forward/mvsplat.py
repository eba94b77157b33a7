"""MVSplat (Chen et al., ECCV 2024): Gaussians from cost volumes, in a single pass.

Modules and their order are those of the published weights, whose keys name them. Shapes: b scenes
of v views are n = b v images, s source views help each of them, and p x q is a quarter of h x w.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from gscompleter.models.feed_forward.cameras import Cameras, list_other_views
from gscompleter.models.feed_forward.cnn import ImageEncoder, normalize_images
from gscompleter.models.feed_forward.cost_volume import compute_cost_volume, space_evenly
from gscompleter.models.feed_forward.gaussian_adapter import (
    MVSPLAT_CHANNELS,
    PixelGaussians,
    create_mvsplat_gaussians,
)
from gscompleter.models.feed_forward.resampling import enlarge
from gscompleter.models.feed_forward.transformer import MultiViewTransformer
from gscompleter.models.feed_forward.unet import (
    Steps,
    UNet,
    create_conv3x3,
    create_conv_block,
    create_refiner,
)

NUM_CANDIDATES = 128
"""Number of candidate inverse depths."""
DOWNSCALE = 4
"""Full resolution divided by the resolution of features and cost volumes, p x q."""


@dataclass(frozen=True)
class MVSplatConfig:
    """Settings shared by the weights for RealEstate10K and ACID."""

    image_size: tuple[int, int] = (256, 256)
    """Height and width of the training images, in pixels; other sizes work too."""
    depth_chunk: int = 16
    """Number of candidates per step; smaller values need less memory."""

    @property
    def patch(self) -> int:
        """Side lengths of the images must be multiples of this, in pixels.

        Both U-Nets halve to a sixteenth of the image: that of the cost volume from a quarter.
        """
        return 16


class Backbone(nn.Module):
    """Features of each view, with and without attention to the other views."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone = ImageEncoder(stride2=2, stride3=1)
        self.transformer = MultiViewTransformer()

    def forward(
        self, images: Float[Tensor, "n 3 h w"], sources: Int[Tensor, "b v s"]
    ) -> tuple[Float[Tensor, "n 128 p q"], Float[Tensor, "n 128 p q"]]:
        """Encode images in [0, 1] into features with and without attention to the `sources`.

        The sources of a view are the indices of other views of its scene.
        """
        alone = self.backbone(normalize_images(images))[-1]
        return self.transformer(alone, sources), alone


class MVSplatDepth(nn.Module):
    """Depth from a cost volume, refined at full resolution, and raw Gaussian channels."""

    def __init__(self, depth_chunk: int) -> None:
        super().__init__()
        self.depth_chunk = depth_chunk
        # 256 channels are 128 of the cost volume, or of other features, and 128 of features.
        coarse = UNet(128, levels=3, attention_level=2, pre_norm=False)
        self.corr_refine_net = create_refiner(256, 128, coarse)
        self.regressor_residual = nn.Conv2d(256, 128, 1)
        self.depth_head_lowres = create_conv_block(128, 256, NUM_CANDIDATES)
        self.upsampler = nn.Sequential(
            create_conv3x3(256, 128),
            nn.Upsample(scale_factor=DOWNSCALE, mode="bilinear", align_corners=True),
            nn.GELU(),
        )
        self.proj_feature = create_conv3x3(128, 32)
        # 37 channels: the image, projected features, coarse inverse depth and its certainty.
        fine = UNet(32, levels=5, attention_level=4, pre_norm=False)
        self.refine_unet = Steps([create_conv3x3(37, 32), nn.GroupNorm(4, 32), nn.GELU(), fine])
        # 163 channels: refined features, the image and features.
        self.to_gaussians = create_conv_block(163, 168, MVSPLAT_CHANNELS)
        self.to_disparity = create_conv_block(32, 64, 2)

    def forward(
        self,
        images: Float[Tensor, "n 3 h w"],
        cross_view: Float[Tensor, "n 128 p q"],
        single_view: Float[Tensor, "n 128 p q"],
        cameras: Cameras,
        sources: Int[Tensor, "b v s"],
    ) -> tuple[Float[Tensor, "n 1 h w"], Float[Tensor, "n 1 h w"], Float[Tensor, "n channels h w"]]:
        """Predict depth, opacity in [0, 1], and the raw channels of the Gaussians.

        The images are in [0, 1], and the depth is in scene units, between near and far. The cost
        volume takes it for z-depth.
        """
        views = sources.shape[1]
        # The cost volume gives a coarse inverse depth, which is enlarged. A U-Net at full
        # resolution then corrects it.
        coarse, certainty = self.estimate_coarse_disparity(cross_view, cameras, sources)
        features = self.upsampler(torch.cat([cross_view, single_view], 1))
        joined = torch.cat([images, self.proj_feature(features), coarse, certainty], 1)
        refined = self.refine_unet(joined, views)
        raw = self.to_gaussians(torch.cat([refined, images, features], 1))
        correction, density = self.to_disparity(refined).split(1, 1)
        disparity = (coarse + correction).clamp(*cameras.compute_inverse_range())
        return 1 / disparity, density.sigmoid(), raw

    def estimate_coarse_disparity(
        self, features: Float[Tensor, "n 128 p q"], cameras: Cameras, sources: Int[Tensor, "b v s"]
    ) -> tuple[Float[Tensor, "n 1 h w"], Float[Tensor, "n 1 h w"]]:
        """Estimate inverse depth and the probability of the best candidate, at full resolution.

        The inverse depth is in 1 / scene units; `features` are those with attention.
        """
        candidates = space_evenly(*cameras.compute_inverse_range(), NUM_CANDIDATES)
        costs = compute_cost_volume(features, cameras, sources, candidates, self.depth_chunk)
        joined = torch.cat([costs, features], 1)
        refined = self.corr_refine_net(joined, sources.shape[1]) + self.regressor_residual(joined)
        probability = self.depth_head_lowres(refined).softmax(1)
        # The expectation over the candidates is finer than their spacing.
        expected = (probability * candidates).sum(1, keepdim=True)
        certainty = probability.amax(1, keepdim=True)
        # The authors enlarge the certainty without interpolation.
        return enlarge(expected, DOWNSCALE), F.interpolate(certainty, scale_factor=DOWNSCALE)


class MVSplat(nn.Module):
    """The MVSplat network: 12 M parameters, trained on pairs of views."""

    def __init__(self, config: MVSplatConfig = MVSplatConfig()) -> None:
        super().__init__()
        self.config = config
        self.backbone = Backbone()
        self.depth_predictor = MVSplatDepth(config.depth_chunk)

    def forward(self, images: Float[Tensor, "b v 3 h w"], cameras: Cameras) -> PixelGaussians:
        """Predict a Gaussian for each pixel of at least two views.

        Colours are in [0, 1], and sides are multiples of `config.patch`. `create_batch`
        (`inputs.py`) crops views to such sides, and refuses what cannot be a batch.
        """
        b, v = images.shape[:2]
        sources = list_other_views(b, v, images.device)
        flat = images.flatten(0, 1)
        informed, alone = self.backbone(flat, sources)
        depth, opacity, raw = self.depth_predictor(flat, informed, alone, cameras, sources)
        # The authors place Gaussians at this depth along unit rays, though the cost volume took it
        # for z-depth. Their weights were trained so, and the difference is learned.
        return create_mvsplat_gaussians(raw, depth, opacity, cameras)
